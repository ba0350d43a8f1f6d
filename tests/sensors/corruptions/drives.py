"""Random sweeps, frames of one car, and a short drive through a ray-cast street."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from hypothesis import strategies as st

from sensors.frame import AgentFrame, Frame
from sensors.motion import Path
from sensors.recording.rig import Rig
from sensors.spec import LidarSpec
from sensors.sweep import STATIC, UNKNOWN_MATERIAL, Sweep, make_sweep
from sim.boxes import Boxes
from sim.geometry import pose_matrix
from sim.mesh.materials import MATERIALS
from sim.scenario import RoadsideUnit
from tests.sensors.fakes import StraightTraffic, box, cars, ground, painted, scene_of, toy_scenario

MATERIAL = {material.name: index for index, material in enumerate(MATERIALS)}
CAR_ID, HELPER_ID = 1001, 1002
STEP_S = 0.1


@dataclass(frozen=True)
class World:
    """A random sensor in a random world: uneven rings, beams without a return, some with two."""

    seed: int
    rings: int
    columns: int
    hit: float
    twice: float
    ranges: tuple[float, float]
    range_10_m: float
    divergence_rad: float
    pulse_s: float
    clockwise: bool

    def sweep(self) -> Sweep:
        """Sweep of the sensor in its world."""
        rng = np.random.default_rng(self.seed)
        near, far = self.ranges
        spec = LidarSpec(
            name="random",
            elevation_deg=tuple(np.sort(rng.uniform(-25.0, 15.0, self.rings))[::-1].tolist()),
            columns=self.columns,
            range_min_m=near,
            range_max_m=far,
            range_10_m=self.range_10_m,
            divergence_rad=self.divergence_rad,
            pulse_s=self.pulse_s,
            clockwise=self.clockwise,
        )
        ring, column = np.nonzero(rng.random((self.rings, self.columns)) < self.hit)
        rows = np.sort(np.append(np.arange(len(ring)), np.flatnonzero(rng.random(len(ring)) < self.twice)))
        echo = 1 + (np.diff(rows, prepend=-1) == 0)
        ring, column, n = ring[rows], column[rows], len(rows)
        elevation, azimuth = spec.elevation[ring], spec.azimuth[column]
        flat = np.cos(elevation)
        ray = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
        reach = (
            np.maximum(near, 0.1)
            + 0.98 * (far - np.maximum(near, 0.1)) * (0.5 * rng.random(n) + 0.5 * (echo == 2)) ** 2
        )
        on_car = rng.random(n) < 0.2
        return make_sweep(
            ray * reach[:, None],
            spec=spec,
            intensity=rng.choice([0.0, 0.02, 0.15, 0.6, 1.0], n) * rng.random(n) ** 0.2,
            ring=ring,
            column=column,
            time_offset=spec.time_offset[ring, column],
            object_id=np.where(on_car, CAR_ID, STATIC),
            return_number=echo,
            material=np.where(on_car, MATERIAL["paint_black"], rng.choice([0, 5, UNKNOWN_MATERIAL], n)),
            cosine=rng.random(n),
        )


worlds = st.builds(
    World,
    seed=st.integers(0, 2**32),
    rings=st.integers(1, 24),
    columns=st.integers(1, 60),
    hit=st.sampled_from([0.0, 0.02, 0.6, 1.0]),
    twice=st.sampled_from([0.0, 0.3]),
    ranges=st.sampled_from([(0.0, 30.0), (0.5, 120.0), (2.0, 250.0)]),
    range_10_m=st.sampled_from([20.0, 100.0, 1e3]),
    divergence_rad=st.sampled_from([1e-4, 1.5e-3, 1e-2]),
    pulse_s=st.sampled_from([1e-9, 5e-9, 2e-8]),
    clockwise=st.booleans(),
)


def one_car_frame(sweep: Sweep, index: int = 0) -> Frame:
    """Frame of an ego and a moving collaborator with the same sweep."""
    time_s = STEP_S * index
    times = time_s + np.array([-STEP_S, 0.0, STEP_S])
    agents = []
    for row, agent_id in enumerate((1000, HELPER_ID)):
        body = pose_matrix(np.stack([9.0 * times, np.full(3, 5.0 * row), np.zeros(3)], 1), 0.1 * times)
        lidar = body @ pose_matrix([0.0, 0.0, 1.9])
        own = replace(sweep, world_from_lidar=lidar[1], time_s=time_s, path=Path.through(times, lidar))
        agents.append(AgentFrame(agent_id, "vehicle", body[1], 9.0, own))
    places = np.array([[15.0, 0.0, 0.75], [0.0, 0.0, 0.75], [0.0, 5.0, 0.75]])
    table = np.concatenate([places, np.tile([4.5, 1.8, 1.5, 0.0], (3, 1))], 1)[[1, 0, 2]]
    truth = Boxes.from_array(table, object_id=np.array([1000, CAR_ID, HELPER_ID]))
    velocity = np.array([[9.0, 0.0], [14.0, 0.0], [9.0, 0.0]])
    points_on = np.array([[np.count_nonzero(a.sweep.object_id == i) for i in truth.object_id] for a in agents])
    return Frame(index, time_s, tuple(agents), truth, velocity, points_on.astype(np.int32))


@cache
def street_drive(frames: int = 3) -> tuple[Frame, ...]:
    """Two cars and a roadside unit on a wet-able road between house fronts, with other cars before them."""
    road = painted(ground(200.0), MATERIAL["asphalt"])
    houses = [box((120.0, 8.0, 9.0), (20.0, y, 4.5), MATERIAL["plaster"]) for y in (-16.0, 14.0)]
    rows = [[0, 0, 0], [14, 0, 0], [-12, -3.5, 0], [26, 3.5, np.pi], [38, -3.5, 0], [9, 3.5, np.pi]]
    traffic = StraightTraffic(cars(rows, speed=[12.0, 13.0, 12.0, 9.0, 14.0, 0.0]), step_s=STEP_S)
    scene = scene_of(road + houses[0] + houses[1])
    unit = RoadsideUnit(xyz_m=(30.0, 8.0, 5.0), yaw_deg=-90.0, pitch_deg=15.0, lidar="debug-16")
    rig = Rig(toy_scenario(roadside=(unit,)), scene, 7)
    steps = [traffic.actors, *(traffic.step() for _ in range(frames + 1))]
    return tuple(
        rig.frame(i, [1000, HELPER_ID, -1], now, before, after)
        for i, (before, now, after) in enumerate(zip(steps, steps[1:], steps[2:], strict=False))
    )
