"""Cells of shares: those of some frames of a drive under one condition, the unit of work of `dsrc shares`.

`KEY.json` holds the rows, under the hash of all that decides them. All that this module imports, at any depth, is
hashed into the keys of cells, see `sim.kept.code_hash`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import msgspec
import numpy as np

from dsrc.data.jsonio import encode_json, read_json
from dsrc.data.sample import Sample, make_sample
from dsrc.evaluation.cache import CellSettings
from dsrc.evaluation.cells import CellJob, detector_of, drive_of
from dsrc.evaluation.detect import FrameHistory, corrupted, interval_of
from dsrc.evaluation.sharing.shares import Shares, share_sample
from dsrc.models.channel import Receiver
from dsrc.models.device import one_thread
from dsrc.runs.unit import Progress, Unit
from sensors.corruptions import drive_seed
from sim.files import write_file


@dataclass(frozen=True, slots=True)
class ShareRow:
    """Share of one agent in one box.

    Attributes:
        drive: name of the drive.
        condition: kind of the corruption, or `clean`.
        frame: number of the frame.
        box: number of the box in the frame.
        object_id: of a true box, -1 for a false detection.
        x_m, y_m, z_m: centre of the box in the ego LiDAR's frame.
        length_m, width_m, height_m, yaw_rad: size and heading of the box.
        ego_id: agent that detects.
        agent_id: agent whose share this is.
        agent: `ego`, `vehicle` or `roadside`.
        heard: its message arrived.
        distance_m: of its LiDAR from the box, in the plane.
        points: its points in the box, as received.
        share: part of `team` that is due to it, see `dsrc.evaluation.sharing.shares`.
        team: best score of the whole team's detections of the box, 0 without one.
        without: the same of the team without this agent; of the ego, which cannot leave, `team`.
    """

    drive: str
    condition: str
    frame: int
    box: int
    object_id: int
    x_m: float
    y_m: float
    z_m: float
    length_m: float
    width_m: float
    height_m: float
    yaw_rad: float
    ego_id: int
    agent_id: int
    agent: str
    heard: bool
    distance_m: float
    points: int
    share: float
    team: float
    without: float

    @property
    def needed(self) -> bool:
        """The team has the box, and has it not without this agent."""
        return self.team > 0 and self.without == 0

    @property
    def prevented(self) -> bool:
        """The team has not the box, and has it without this agent."""
        return self.team == 0 and self.without > 0


class ShareSettings(CellSettings, frozen=True, kw_only=True):
    """Settings of a cell of shares.

    Attributes:
        iou: least overlap in bird's-eye view of a detection with the box that it is of.
    """

    iou: float


class _Rows(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a cell."""

    settings: ShareSettings
    rows: tuple[ShareRow, ...]


def make_share_cells(unit: Unit[CellJob], progress: Progress) -> None:
    """Compute and write cells of shares."""
    for key, job in unit.jobs.items():
        reader = drive_of(job.drive)
        name, seed = reader.drive.name, drive_seed(job.settings.seed, reader.drive.name)
        read = lru_cache(maxsize=3)(reader.read)
        if not isinstance(job.settings, ShareSettings):
            raise TypeError(f"cells of shares have ShareSettings, got {type(job.settings)}")
        detector = detector_of(job)
        receiver = job.channel and Receiver(job.channel, seed, interval_of(reader), detector.settings)
        rows: list[ShareRow] = []
        with one_thread():
            for done, i in enumerate(job.settings.positions, 1):
                past = FrameHistory(read, i, partial(corrupted, condition=job.condition, seed=seed))
                whole = make_sample(past[0], None, detector.settings.request, recorded=read(i))
                whole = replace(whole, key=f"{name}/{whole.key}")
                heard = receiver.receive(past, i, whole, detector.settings.request.grid)[0] if receiver else whole
                found = share_sample(detector, heard, job.settings.iou, whole.agent_ids)
                rows += _rows(found, heard, whole, name, job.condition.kind, past[0].index)
                progress(done, len(job.settings.positions))
        write_file(unit.folder / f"{key}.json", encode_json(_Rows(job.settings, tuple(rows))))


def read_share_cell(folder: Path, key: str) -> Sequence[ShareRow]:
    """Rows of a cell.

    Raises:
        DataError: it is missing or damaged.
    """
    return read_json(folder / f"{key}.json", _Rows).rows


def _rows(shares: Shares, heard: Sample, whole: Sample, drive: str, condition: str, frame: int) -> list[ShareRow]:
    boxes, rows = shares.boxes, []
    columns = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
    places = [dict(zip(columns, values, strict=True)) for values in boxes.array.round(3).tolist()]
    for k, agent in enumerate(whole.agent_ids):
        away = np.linalg.norm(boxes.center[:, :2] - whole.ego_from_agent[k][:2, 3], axis=1)
        points = np.zeros(len(boxes), np.int64)
        if shares.heard[k]:
            cloud = heard.clouds[heard.agent_ids.index(agent)]
            points = boxes.contains(cloud[:, :3].astype(np.float64)).sum(axis=1)
        for box in range(len(boxes)):
            rows.append(
                ShareRow(
                    drive=drive,
                    condition=condition,
                    frame=frame,
                    box=box,
                    object_id=int(boxes.object_id[box]) if shares.true[box] else -1,
                    **places[box],
                    ego_id=whole.agent_ids[0],
                    agent_id=agent,
                    agent="ego" if k == 0 else "roadside" if agent < 0 else "vehicle",
                    heard=bool(shares.heard[k]),
                    distance_m=round(float(away[box]), 2),
                    points=int(points[box]),
                    share=float(shares.share[k, box]),
                    team=float(shares.team[box]),
                    without=float(shares.without[k, box]),
                )
            )
    return rows


def read_share_settings(folder: Path, key: str) -> ShareSettings:
    """Settings of a cell; raises DataError where it is missing or damaged."""
    return read_json(folder / f"{key}.json", _Rows).settings
