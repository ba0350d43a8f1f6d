"""Shares of agents in the detections of drives, `dsrc shares`: clean and corrupted, through a radio channel."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, fields, replace
from functools import lru_cache, partial
from typing import Any

import msgspec
import numpy as np

from dsrc.data.drives import Drive, list_drives, open_drive
from dsrc.data.executors import Progress
from dsrc.data.provenance import provenance
from dsrc.data.sample import Sample, SampleDetector, sample_for
from dsrc.evaluation.conditions import Condition, check_numbers, corruption_kinds
from dsrc.evaluation.detect import FrameHistory, corrupted, frame_positions, interval_of
from dsrc.evaluation.shares import Shares, share_sample
from dsrc.models.channel import Receiver
from dsrc.models.storage.checkpoint import load_student
from dsrc.options.detection import Sharing
from sensors.corruptions import drive_seed, parse_who
from sim.files import file_sha256
from sim.radio import ChannelSpec, get_channel


@dataclass(frozen=True, slots=True)
class ShareRow:
    """Share of one agent in one box.

    Attributes:
        drive: name of the drive.
        condition: kind of the corruption, or `clean`.
        frame: number of the frame.
        box: number of the box in the frame.
        object_id: of a true box, -1 for a false detection.
        x_m: place of the box in the ego LiDAR's frame.
        y_m: its second coordinate.
        ego_id: agent that detects.
        agent_id: agent whose share this is.
        agent: `ego`, `vehicle` or `roadside`.
        heard: its message arrived.
        distance_m: of its LiDAR from the box, in the plane.
        points: its points in the box, as received.
        share: part of `team` that is due to it, see `dsrc.evaluation.shares`.
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


def share_drives(config: Sharing, progress: Progress | None = None) -> list[ShareRow]:
    """Shares in all frames of the drives under each condition, in the order of drives, frames and conditions.

    Args:
        config: see `Sharing`.
        progress: called with frames done and frames to do.

    Raises:
        UserError: a file, a drive or a setting is wrong.
    """
    check_numbers("shares", (config.severity,), config.seed, config.limit)
    parse_who(config.who)
    kinds = corruption_kinds(config.corruptions, config.family, "shares")
    conditions = [Condition(), *(Condition(kind, config.severity, config.family, config.who) for kind in kinds)]
    channel = None if config.channel is None else get_channel(config.channel)
    detector = load_student(config.checkpoint, config.device, config.engine)
    readers = [open_drive(path) for path in list_drives(config.data)]
    positions = frame_positions(readers, config.limit)
    done, total = 0, len(conditions) * sum(map(len, positions))
    rows: list[ShareRow] = []
    for reader, own in zip(readers, positions, strict=True):
        for found in _shares(detector, reader, own, conditions, channel, config):
            rows += found
            done += 1
            if progress is not None:
                progress(done, total)
    return rows


def _shares(
    detector: SampleDetector,
    reader: Drive,
    positions: Sequence[int],
    conditions: Sequence[Condition],
    channel: ChannelSpec | None,
    config: Sharing,
) -> Iterator[list[ShareRow]]:
    """Yield the rows of each frame under each condition."""
    settings, seed = detector.settings, drive_seed(config.seed, reader.drive.name)
    receiver = None if channel is None else Receiver(channel, seed, interval_of(reader), settings)
    read = lru_cache(maxsize=3)(reader.read)
    for i in positions:
        recorded = FrameHistory(read, i)
        for condition in conditions:
            past = FrameHistory(recorded.at, i, partial(corrupted, condition=condition, seed=seed))
            whole = sample_for(settings, past[0], None)
            whole = replace(whole, key=f"{reader.drive.name}/{whole.key}")
            heard = whole if receiver is None else receiver.receive(past, i, whole, settings.grid)[0]
            found = share_sample(detector, heard, config.iou, whole.agent_ids)
            yield _rows(found, heard, whole, reader.drive.name, condition.kind, past[0].index)


def _rows(shares: Shares, heard: Sample, whole: Sample, drive: str, condition: str, frame: int) -> list[ShareRow]:
    boxes, rows = shares.boxes, []
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
                    x_m=round(float(boxes.center[box, 0]), 2),
                    y_m=round(float(boxes.center[box, 1]), 2),
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


def rows_csv(rows: Sequence[ShareRow]) -> str:
    """CSV of rows, a line each, with a header."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in fields(ShareRow)])
    writer.writerows(astuple(row) for row in rows)
    return text.getvalue()


def provenance_of(config: Sharing) -> dict[str, Any]:
    """Provenance of shares: settings, hashes of the detector and the data, versions."""
    settings = msgspec.to_builtins(config, enc_hook=str)
    for name in ("out", "output"):
        settings.pop(name, None)
    settings["data"], settings["checkpoint"] = config.data.name, config.checkpoint.name
    settings["sha256"] = file_sha256(config.checkpoint)
    return provenance(settings, config.seed, list_drives(config.data))
