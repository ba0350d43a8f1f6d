"""A gain by the score from which boxes count."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from dsrc.data.drives import open_drive
from dsrc.data.sample import Sample
from dsrc.evaluation.cache import CellSettings, write_cell
from dsrc.evaluation.detect import Method, evaluate_drive
from dsrc.evaluation.stored import StoredDrive, StoredIndex, StoredRun, write_index
from dsrc.ops.detections import Detections
from sensors.corruptions import Condition
from tests.commands import study
from tests.dsrc.evaluation.fakes import GRID, PointCounter
from tests.dsrc.evaluation.small import write_drives


class Scorer(PointCounter):
    """Detects all true boxes with one score, moved along x."""

    def __init__(self, score: float, moved_m: float) -> None:
        super().__init__(need=0, offset=moved_m)
        self.score = score

    def detect(self, sample: Sample) -> Detections:
        found = super().detect(sample)
        return replace(found, score=np.full_like(found.score, self.score))


def write_results(out: Path, drives: Path, seen: dict[str, dict[int, tuple[float, float]]]) -> None:
    """Write results of methods whose trainings find all boxes with a score, moved by so many metres."""
    readers = [open_drive(path) for path in sorted(drives.iterdir())]
    runs = []
    for method, trainings in seen.items():
        for training, (score, moved_m) in trainings.items():
            cells = []
            for reader in readers:
                tested = Method(method, Scorer(score, moved_m))
                found = evaluate_drive(reader, [0, 1], {Condition(): [tested]}, 0)
                settings = CellSettings(
                    detector=f"{method} {training}",
                    use={},
                    drive=reader.drive.name,
                    data=reader.digest(),
                    positions=(0, 1),
                    condition={},
                    seed=0,
                    channel=None,
                    agents=1,
                    device="cpu",
                    engine="torch",
                    versions={},
                    code="",
                )
                write_cell(out / "cells", settings, found[Condition(), method])
                cells.append((settings.key,))
            run = StoredRun(
                method=method,
                training=training,
                kind="clean",
                severity=0,
                family="physical",
                channel="ideal",
                detector="0" * 64,
                range_m=GRID.range_m,
                agents=1,
                cells=tuple(cells),
            )
            runs.append(run)
    stored = [StoredDrive(dataset="toy", path=str(reader.drive), data=reader.digest()) for reader in readers]
    write_index(out, StoredIndex(seed=0, drives=tuple(stored), runs=tuple(runs)))


def test_a_method_is_ahead_where_its_boxes_count_and_the_other_s_do_not(tmp_path: Path) -> None:
    """A method finds all with a score of 0.3; of its rival one training does, with 0.5, and one is 20 m off."""
    sure, off = (0.5, 0.0), (0.5, 20.0)
    trainings = {"DSRC": {0: (0.3, 0.0), 1: (0.3, 0.0)}, "rival": {0: sure, 1: off}, "one": {0: sure}}
    write_results(tmp_path / "toy", write_drives(tmp_path / "data"), trainings)
    script = "dsrc_paper.score_thresholds"
    scores = ("--scores", "0.2", "0.3", "0.4", "0.6")
    *_, half, most = study(script, str(tmp_path / "toy"), "--baseline", "rival", *scores).splitlines()
    ahead, behind = "**+50.0 [+50.0, +50.0]**", "**-50.0 [-50.0, -50.0]**"
    assert half == f"| clean, 0.5 | {ahead} | {ahead} | {behind} | +0.0 [+0.00, +0.00] |"
    assert most == half.replace("0.5", "0.7", 1)
    several = study(script, str(tmp_path / "toy"), "--baseline", "rival", "one", *scores).splitlines()[-2:]
    cells = [line.strip("| ").split(" | ") for line in several]
    assert cells[0][:2] == ["DSRC − rival", "clean"]
    assert cells[0][2:] == ["**+50.0** / **+50.0**", "**+50.0** / **+50.0**", "**-50.0** / **-50.0**", "+0.0 / +0.0"]
    assert cells[1][2:] == ["+0.0 / +0.0", "+0.0 / +0.0", "**-100.0** / **-100.0**", "+0.0 / +0.0"]
