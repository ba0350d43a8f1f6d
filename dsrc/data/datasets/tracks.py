"""Track files as recorded traffic: a traffic log and a world, which are rendered like any other."""

import re
from pathlib import Path

import numpy as np
import shapely
import trimesh

from dsrc.data.drive_folder import TRAFFIC_LOG, WORLD
from sim.errors import DataError, complaint
from sim.mesh.solids import Height, carpet, join, to_mesh
from sim.scenario import AgentRule, Scenario
from sim.traffic.staying import staying_ids
from sim.traffic.tracks.base import STEP_S, Recording, to_log
from sim.traffic.tracks.open import read_tracks
from sim.world.world_file import save_world, shapes_of

AGENTS = 3
"""Most vehicles with a LiDAR where none are chosen."""
BEYOND_M = 400.0
"""Ground beyond all road users and lanes, farther than any sensor sees, m."""
_ROAD_M = 0.02
"""Height of lanes above the ground beside them, m."""
_MARGIN = 1
"""Steps after the last frame, for the second half of its sweep."""


def record_tracks(path: Path, folder: Path) -> list[Path]:
    """Write the traffic log and the world of each recording of a track file, and return the logs.

    The ground is flat, at the height on which the road users stand; lanes are asphalt. Vehicles with a LiDAR are up to
    `AGENTS` of those that stay from first to last, unless others are chosen when the log is rendered.

    Args:
        path: in any format of `sim.traffic.tracks`.
        folder: gets `traffic.npz` and `world.npz`; where the file holds several recordings, a folder for each.

    Raises:
        DataError: the file is missing or wrong, or a recording too short for a frame.
    """
    return [_record(path, recording, folder / recording.part) for recording in read_tracks(path)]


def _record(path: Path, recording: Recording, folder: Path) -> Path:
    log = to_log(path, recording)
    frames = len(log) - _MARGIN
    if frames < 1:
        raise DataError(complaint(path, "time", f"tracks of at least {_MARGIN * STEP_S:g} s", f"{len(log)} step"))
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", " ".join([path.stem, recording.part]).strip()) or "tracks"
    scenario = Scenario(
        name=name,
        description=f"Tracks of {path.name}",
        agents=AgentRule(vehicles=1),
        warmup_s=0.0,
        duration_s=STEP_S * len(log),
        step_s=STEP_S,
    )
    staying = len(staying_ids([log[step] for step in range(frames)], scenario))
    about = {
        "scenario": {
            "name": name,
            "description": scenario.description,
            "agents": {"vehicles": min(max(staying, 1), AGENTS)},
            "warmup_s": 0.0,
            "duration_s": scenario.duration_s,
        },
        "seed": 0,
        "frames": frames,
        "interval_s": STEP_S,
        "tracks": path.name,
    }
    log.about = about
    log.save(folder / TRAFFIC_LOG)
    models = {model for step in range(len(log)) for model in log[step].model}
    save_world(_world(recording), shapes_of(models), folder / WORLD)
    return folder / TRAFFIC_LOG


def _world(recording: Recording) -> trimesh.Trimesh:
    """Return the ground, with lanes on it."""
    ground_m = recording.ground_m
    places = np.concatenate([*(one.center[:, :2] for one in recording.tracks), *recording.lanes])
    low, high = places.min(axis=0) - BEYOND_M, places.max(axis=0) + BEYOND_M
    field = shapely.box(*low, *high)
    if not recording.lanes:
        return to_mesh(carpet(field, _level(ground_m), 0.0, "asphalt"))
    road = shapely.union_all([shapely.make_valid(shapely.Polygon(outline)) for outline in recording.lanes])
    return to_mesh(
        join(
            [
                carpet(field, _level(ground_m - _ROAD_M), 0.0, "ground"),
                carpet(road, _level(ground_m), 0.0, "asphalt"),
            ]
        )
    )


def _level(height_m: float) -> Height:
    return lambda xy: np.full(len(xy), height_m)
