"""Frames in pictures: selected by rule, and read."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from dsrc.data.drives import Drive, list_drives, open_drive
from dsrc.data.sample import Sample, make_sample
from dsrc.evaluation.config import Benchmark
from dsrc.evaluation.detect import corrupted, frame_positions
from dsrc.evaluation.report.dataset_results import PAPER_SEVERITY
from dsrc.ops.grid import GridSpec
from sensors.corruptions import Condition, drive_seed
from sim.boxes import Boxes
from sim.errors import SettingsError, complaint
from sim.geometry import invert
from sim.settings import convert

_COUNTED_FRAMES = 24


class PictureSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pictures of single frames of the first dataset, Figures 6 and 8.

    Attributes:
        teacher: detector file of DSRC's teacher, for the feature maps; "" for none.
        methods: methods of the drawn detections; empty: the first three and the last.
        percentiles: of frames by the number of true boxes with points from helpers alone, a frame each, see
            `frames_at`.
        corruption: of the frames.
    """

    teacher: str = ""
    methods: tuple[str, ...] = ()
    percentiles: Annotated[tuple[Annotated[int, Meta(ge=0, le=100)], ...], Meta(min_length=1)] = (25, 50, 75)
    corruption: str = "clean"


def pictures_of(plan: Benchmark) -> PictureSpec:
    """Settings of a benchmark's pictures.

    Raises:
        SettingsError: a setting is unknown or invalid.
    """
    spec = convert(plan.pictures, PictureSpec, plan.name, SettingsError, field="pictures")
    names = [method.name for method in plan.methods]
    for name in spec.methods:
        if name not in names:
            raise SettingsError(complaint(plan.name, "pictures.methods", f"one of {', '.join(names)}", name))
    return spec


@dataclass(frozen=True, slots=True)
class DrawnFrame:
    """Frame in a picture.

    Attributes:
        sample: of the ego and its collaborators.
        title: drive, number and condition of the frame.
        percentile: of the frame, see `frames_at`.
        ego: the ego's own body, not part of the ground truth, in its LiDAR's frame; empty where unknown.
    """

    sample: Sample
    title: str
    percentile: int
    ego: Boxes = field(default_factory=Boxes.zeros)

    @property
    def helped(self) -> str:
        """Count of true boxes with points from helpers alone, as text."""
        return f"{only_helpers_see(self.sample).sum()} of {len(self.sample.boxes)} true boxes seen by helpers alone"

    @property
    def heading(self) -> str:
        """Heading of a column of pictures."""
        return f"Percentile {self.percentile}\n{self.title}\n{self.helped}"


def only_helpers_see(sample: Sample) -> NDArray[np.bool_]:
    """(N,) true boxes with points from helpers and none from the ego, in the sweeps as recorded."""
    return ~np.isin(sample.boxes.object_id, sample.agent_boxes[0].object_id)


def frames_at(plan: Benchmark, grid: GridSpec) -> list[tuple[int, Drive, int]]:
    """Percentile, drive and position of the drawn frames, selected by rule.

    Evaluated frames of the first dataset with true boxes in the grid's range that have points from helpers alone are
    sorted by the number of these boxes, equal ones by drive and frame; where no frame has any, all frames are sorted.
    The frame at percentile p of n is number ceil(p / 100 * n), at least the first: nearest rank, definition 1 of
    Hyndman and Fan, Sample Quantiles in Statistical Packages, 1996.

    Raises:
        DataError: the dataset has no frame.
    """
    readers = _readers(plan)
    places = frame_positions(readers, plan.frames)
    ranked = []
    for row, (reader, positions) in enumerate(zip(readers, places, strict=True)):
        for position in positions:
            seen = make_sample(reader.read(position), None, grid, cooperative=False)
            count, number = int(only_helpers_see(seen).sum()), reader.frames[position]
            ranked.append((count, reader.drive.name, number, row, position))
    ranked.sort()
    ranked = [one for one in ranked if one[0]] or ranked
    chosen = []
    for percentile in pictures_of(plan).percentiles:
        *_, row, position = ranked[max(1, math.ceil(percentile * len(ranked) / 100)) - 1]
        chosen.append((percentile, readers[row], position))
    return chosen


def read_drawn_frames(plan: Benchmark, grid: GridSpec) -> list[DrawnFrame]:
    """Frames of a benchmark's pictures, see `frames_at`, under their condition.

    Raises:
        DataError: the dataset has no frame.
    """
    kind = pictures_of(plan).corruption
    condition = Condition.of(kind, PAPER_SEVERITY, plan.family[0], plan.corrupted_agents)
    chosen = []
    for percentile, reader, position in frames_at(plan, grid):
        name = reader.drive.name
        frame = corrupted(reader.read(position), condition, drive_seed(plan.seed, name))
        sample = make_sample(frame, None, grid)
        pose = frame.agent(sample.agent_ids[0]).sweep.world_from_lidar
        ego = frame.truth[frame.truth.object_id == sample.agent_ids[0]].transform(invert(pose))
        chosen.append(DrawnFrame(sample, f"{name}, frame {reader.frames[position]}, {kind}", percentile, ego))
    return chosen


def spread_samples(plan: Benchmark, grid: GridSpec) -> list[Sample]:
    """Samples of clean frames for the count of channels, evenly spread over the first dataset."""
    readers = _readers(plan)
    places = frame_positions(readers, min(_COUNTED_FRAMES, plan.frames or _COUNTED_FRAMES))
    return [
        make_sample(reader.read(position), None, grid)
        for reader, positions in zip(readers, places, strict=True)
        for position in positions
    ]


def _readers(plan: Benchmark) -> list[Drive]:
    return [open_drive(drive) for folder in plan.datasets[0].drives for drive in list_drives(Path(folder))]
