"""Frames to corrupt: two cars and a roadside unit on the street with a parked car, driving for some seconds."""

from dataclasses import replace

import numpy as np

from sensors.frame import AgentFrame, Frame
from sensors.motion import Path
from sensors.sweep import STATIC, Sweep, make_sweep
from sim.boxes import Boxes
from sim.geometry import pose_matrix
from tests.sensors.corruptions.street import spinning, street

SPEED = 10.0
AGENTS = (1000, 1003, -1)
PARKED, PARKED_RING = 1500, 8
"""Standing car, and the ring of its points."""


def frame(index: int = 0, agents: tuple[int, ...] = AGENTS, sweep: Sweep | None = None) -> Frame:
    """Frame of agents that drive east with the same sweep of a street, and a standing mast."""
    sweep = street(spinning(16)) if sweep is None else sweep
    time_s = 0.1 * index
    ids = [*(i for i in agents if i >= 0), PARKED]
    places = [*([SPEED * time_s, i] for i in ids[:-1]), [20.0, 8.0]]
    rows = np.concatenate([places, np.tile([0.75, 4.5, 1.8, 1.5, 0.0], (len(ids), 1))], axis=1)
    velocity = np.where(np.array(ids)[:, None] == PARKED, 0.0, [SPEED, 0.0])
    points_on = np.where(np.array(ids) == PARKED, np.count_nonzero(sweep.ring == PARKED_RING), 0)
    return Frame(
        index=index,
        time_s=time_s,
        agents=tuple(agent(agent_id, time_s, sweep) for agent_id in agents),
        truth=Boxes.from_array(rows, object_id=np.array(ids)),
        velocity=velocity,
        points_on=np.tile(points_on, (len(agents), 1)).astype(np.int32),
    )


def agent(agent_id: int, time_s: float, sweep: Sweep) -> AgentFrame:
    """An agent whose sensor is 1.9 m above its body, with its path over the sweep."""
    speed = SPEED if agent_id >= 0 else 0.0
    times = time_s + np.array([-0.1, 0.0, 0.1])
    body = pose_matrix(np.stack([speed * times, np.full(3, float(agent_id)), np.zeros(3)], axis=1), np.zeros(3))
    lidar = body @ pose_matrix([0.0, 0.0, 1.9])
    columns = {name: getattr(sweep, name) for name in ("intensity", "ring", "column", "time_offset")}
    columns["object_id"] = np.where(sweep.ring == PARKED_RING, PARKED, STATIC)
    own = make_sweep(sweep.points, lidar[1], time_s, sweep.spec, **columns)
    own = replace(own, path=Path.through(times, lidar))
    kind = "vehicle" if agent_id >= 0 else "roadside"
    return AgentFrame(agent_id, kind, body[1], speed, own)
