"""Why a team falls below its ego in snow: detectors alone and as a team, with snow changed bit by bit.

Usage:
    python -m studies.dsrc_paper.snow --data data/dsrc-sim/test --out runs/snow --docs studies/dsrc_paper/report.md
    python -m studies.dsrc_paper.snow --data data/test --out runs/snow --checkpoint detector.pt --frames 8

Every line is of the same frames, drives' seeds and flakes. Cells are stored in `OUT/cells`, so that an interrupted run
resumes; `OUT/snow.csv` has all numbers. With `--calibration`, see `PaperSnow`, the published snow is measured with it,
too.
"""

import argparse
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.cli.progress import progress
from dsrc.data.drives import open_drives, traffic_runs
from dsrc.detectors.open import detector_sha256, open_detector
from dsrc.evaluation.cache import CellSettings, read_cell
from dsrc.evaluation.cells import CellJob, make_cells
from dsrc.evaluation.config import named
from dsrc.evaluation.detect import frame_positions, join_results
from dsrc.evaluation.metrics.intervals import (
    IOUS,
    RESAMPLES,
    Interval,
    RankedDetections,
    draw_weights,
    percentile_interval,
    resampled_ap,
)
from dsrc.evaluation.report.differences import SEED
from dsrc.evaluation.runner import CELLS
from dsrc.runs.executors import SERIAL
from dsrc.runs.provenance import provenance
from dsrc.tables.files import csv_text
from sensors.corruptions import Condition
from sensors.frame import AgentFrame, Frame
from sensors.sweep import SCATTERED, Sweep
from sim.errors import UserError
from sim.files import write_file
from sim.kept.code_hash import code_hash, own_code_hash, package_versions
from studies.look import put_table

SHIPPED = tuple(f"dsrc/checkpoints/{name}.pt" for name in ("small-plain", "small-dsrc", "small-dsrc-corrupted"))
TALL_M = 1.0

Edit = Callable[[AgentFrame], Sweep]
"""The sweep that an agent has instead of its corrupted one."""


def heights(agent: AgentFrame) -> NDArray[np.float32]:
    """Return (P,) heights of an agent's points above the road that it stands on, m; the sensor is upright."""
    sweep = agent.sweep
    return sweep.points[:, 2] + np.float32(sweep.world_from_lidar[2, 3] - agent.world_from_body[2, 3])


def without(flakes: Callable[[AgentFrame], NDArray[np.bool_]]) -> Edit:
    """Return the edit that takes those flakes away of which a mask holds."""
    return lambda agent: agent.sweep[~((agent.sweep.fate == SCATTERED) & flakes(agent))]


def laid_down(agent: AgentFrame) -> Sweep:
    """Return the sweep with its flakes on the road below them."""
    points = agent.sweep.points.copy()
    flakes = agent.sweep.fate == SCATTERED
    points[flakes, 2] -= heights(agent)[flakes]
    return replace(agent.sweep, points=points)


EDITS: Mapping[str, Edit] = {
    "bare": without(lambda agent: np.ones(len(agent.sweep), bool)),
    "low": without(lambda agent: heights(agent) >= TALL_M),
    "laid": laid_down,
}


@dataclass(frozen=True, slots=True)
class Changed(Condition):
    """Condition whose sweeps are edited after it.

    Attributes:
        edit: key of `EDITS`.
    """

    edit: str = "bare"

    def apply(self, frame: Frame, seed: int, ego_id: int | None = None) -> Frame:
        """Return the frame under the condition, its agents' sweeps edited."""
        made = Condition.apply(self, frame, seed, ego_id)
        return made.with_sweeps([EDITS[self.edit](agent) for agent in made.agents])

    def decisive(self) -> dict[str, Any]:
        """Return what decides the sweeps."""
        return {**Condition.decisive(self), "edit": self.edit, "code": own_code_hash(Changed)}


@dataclass(frozen=True, slots=True)
class Line:
    """Line of the table.

    Attributes:
        title: of the line.
        condition: of the sweeps.
        use: changed settings of the detectors.
    """

    title: str
    condition: Condition
    use: tuple[tuple[str, Any], ...] = ()


def lines(calibration: Path | None) -> Iterator[Line]:
    """Yield the lines of the table."""
    drop = (("drop_lone_points", True),)
    clean, sparse, snow = Condition(), Condition("cross_sensor", 3), Condition("snow", 3)
    published = replace(snow, family="paper")
    yield Line("clear air", clean)
    yield Line("the same, lone points dropped", clean, drop)
    yield Line("cross sensor, ours", sparse)
    yield Line("the same, lone points dropped", sparse, drop)
    yield Line("**snow, ours**", snow)
    yield Line("the same, lone points dropped", snow, drop)
    yield Line("the ego's sweep alone in snow", replace(snow, agents="ego"))
    yield Line("the helpers' sweeps alone in snow", replace(snow, agents="helpers"))
    for edit, title in (
        ("bare", "no flakes: surfaces dimmed and lost alone"),
        ("laid", "flakes laid down on the road"),
        ("low", f"flakes only below {TALL_M:g} m"),
    ):
        yield Line(title, Changed("snow", 3, edit=edit))
    yield Line("boxes count from a score of 0.05", snow, (("score_threshold", 0.05),))
    yield Line("a twentieth of the message", snow, (("share", 0.05),))
    yield Line("**snow, as published**", published)
    yield Line("the same, lone points dropped", published, drop)
    unfloored = replace(published, settings=(("noise_factor", None),))
    yield Line("without the noise floor", unfloored)
    yield Line("without it, lone points dropped", unfloored, drop)
    if calibration is not None:
        calibrated = replace(published, settings=(("calibration", str(calibration)),))
        yield Line("with the calibration of an HDL-64E", calibrated)
        yield Line("with it, lone points dropped", calibrated, drop)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="drives")
    parser.add_argument("--out", type=Path, required=True, help="folder of the cells and of snow.csv")
    parser.add_argument("--checkpoint", nargs="+", default=SHIPPED, help="detectors, [NAME=]FILE; default: the shipped")
    parser.add_argument("--frames", type=int, default=46, help="evenly spread: %(default)s when left out")
    parser.add_argument("--calibration", type=Path, help="npz file of an HDL-64E's focus")
    parser.add_argument("--docs", type=Path, help="document whose table `snow` is replaced")
    options = parser.parse_args()
    try:
        records = list(measured(options))
    except UserError as error:
        parser.error(str(error))
    detectors = dict(named(options.checkpoint))
    hashes = {name: detector_sha256(text) for name, text in detectors.items()}
    data = {reader.drive.name: reader.digest() for reader in open_drives(options.data)}
    made_by = provenance({"detectors": hashes, "frames": options.frames}, 0, data)
    write_file(options.out / "snow.csv", csv_text(records, made_by=made_by))
    names = list(detectors)
    head = ["AP@0.5 / 0.7, %", *(part for name in names for part in (f"{name}, alone", "team", "gain at 0.5"))]
    rows = [
        [records[first]["line"], *(cell for one in records[first : first + len(names)] for cell in cells_of(one))]
        for first in range(0, len(records), len(names))
    ]
    put_table(options.docs, "snow", head, rows)


def cells_of(record: Mapping[str, Any]) -> Iterator[str]:
    """Yield the cells of a detector in a line: alone, as a team, and the gain with its interval, bold off 0."""
    for who in ("alone", "team"):
        yield " / ".join(f"{record[f'{who}_{iou:g}']:.1f}" for iou in IOUS)
    interval = Interval(record["low"] / 100.0, record["high"] / 100.0)
    text = f"{record['team_0.5'] - record['alone_0.5']:+.1f}"
    if not math.isnan(interval.low):  # one drive tells nothing of others
        text += f" {interval.points}"
    yield f"**{text}**" if interval.excludes_zero else text


def measured(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Compute the cells that are missing; yield line, detector, points of AP and, at 0.5, the gain's interval."""
    readers = open_drives(options.data)
    places = list(zip(readers, frame_positions(readers, options.frames), strict=True))
    drives = [Part(reader.drive, reader.digest(), tuple(own)) for reader, own in places if own]
    traffic = traffic_runs([reader for reader, own in places if own])
    detectors = {name: Tested.of(text) for name, text in named(options.checkpoint)}
    wanted = {
        (line, name): [jobs_of(line, detector, agents, drives) for agents in (1, detector.agents)]
        for line in lines(options.calibration)
        for name, detector in detectors.items()
    }
    jobs = {job.settings.key: job for pair in wanted.values() for cells in pair for job in cells}
    with progress("snow") as report:
        CELLS.run(options.out / "cells", jobs, SERIAL, report)
    number = np.repeat(traffic, [len(part.positions) for part in drives])
    drawn = draw_weights(number, RESAMPLES, np.random.default_rng(SEED))
    weights = np.concatenate([np.ones((1, len(number)), np.float32), drawn])
    for (line, name), pair in wanted.items():
        found = [[read_cell(options.out / "cells", job.settings.key) for job in cells] for cells in pair]
        alone, team = (resampled_ap(RankedDetections.of(join_results(part).matches), weights) for part in found)
        interval = percentile_interval((team - alone)[0, 1:], len(set(traffic)))
        yield {
            "line": line.title,
            "condition": line.condition.label,
            "use": ", ".join(f"{name} {value}" for name, value in line.use),
            "detector": name,
            **{f"alone_{iou:g}": 100.0 * part[0] for iou, part in zip(IOUS, alone, strict=True)},
            **{f"team_{iou:g}": 100.0 * part[0] for iou, part in zip(IOUS, team, strict=True)},
            "low": 100.0 * interval.low,
            "high": 100.0 * interval.high,
        }


@dataclass(frozen=True, slots=True)
class Part:
    """Frames of a drive: its path, its hash and their positions."""

    drive: Path
    digest: str
    positions: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Tested:
    """Detector file: its path, its hash and the most agents that it fuses."""

    text: str
    sha256: str
    agents: int

    @classmethod
    def of(cls, text: str) -> "Tested":
        """Return that of a path."""
        return cls(text, detector_sha256(text), open_detector(text).settings.request.max_agents)


def jobs_of(line: Line, detector: Tested, agents: int, drives: Sequence[Part]) -> list[CellJob]:
    """Return the cells of a detector in a line, one for each drive."""
    limit = agents if agents < detector.agents else None
    return [
        CellJob(
            CellSettings(
                detector=detector.sha256,
                use=dict(line.use),
                drive=part.drive.name,
                data=part.digest,
                positions=part.positions,
                condition=line.condition.decisive(),
                seed=0,
                channel=None,
                agents=agents,
                device="cpu",
                engine="fused",
                versions=package_versions(make_cells.__module__),
                code=code_hash(make_cells.__module__),
            ),
            *(detector.text, part.drive, line.condition, limit, None),
        )
        for part in drives
    ]


if __name__ == "__main__":
    main()
