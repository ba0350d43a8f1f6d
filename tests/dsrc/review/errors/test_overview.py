"""Overview of a run: what was lost, sorted, and links to the worst of each cell."""

from dataclasses import replace

import numpy as np
import pytest

from dsrc.evaluation.detection_table import DetectionTable
from dsrc.review.errors.overview import Overview, Overviews
from dsrc.review.model import ReviewModel
from dsrc.review.page.link import read_link, write_link
from dsrc.review.sources.base import DriveSource, MemorySet, Setup, Source
from dsrc.review.sources.moment import EpisodeTimeline
from dsrc.review.state import ReviewState
from sensors.corruptions import Condition
from sim.errors import DataError
from tests.dsrc.review.conftest import FakeDetector, FakeDrive
from tests.dsrc.review.errors.runs import draw_table

SKILL = {"clean": 0.95, "snow": 0.4, "fog": 0.7}


def judged(methods: dict[str, float], drives: int = 1, seed: int = 3) -> ReviewModel:
    """Two methods of some skill under three conditions."""
    sources = []
    for drive in range(drives):
        source = DriveSource(FakeDrive())
        source.name = f"street {drive}"
        for name, share in methods.items():
            own = MemorySet(name)
            for kind, skill in SKILL.items():
                setup = Setup(Condition() if kind == "clean" else Condition(kind, 3))
                for table in draw_table(seed + drive, skill=skill * share).frames():
                    own.put(int(table.position[0]), table, setup)
            source.sets[name] = own
        sources.append(source)
    return ReviewModel(sources)


def overview(model: ReviewModel, state: ReviewState | None = None) -> Overview:
    found = Overviews(model).of(state or ReviewState(), 60.0)
    assert found.whole
    return found


def column(found: Overview, name: str) -> list[str]:
    return [row[found.head.index(name)].text for row in found.rows]


def test_what_lost_most_against_clean_comes_first() -> None:
    found = overview(judged({"DSRC": 1.0}))
    assert [row[0].text for row in found.rows] == ["snow 3", "fog 3", "clean"]
    lost = [int(text) for text in column(found, "lost")[:2]]
    ap = [int(text) for text in column(found, "AP50")]
    assert lost[0] > lost[1] > 0
    assert np.allclose(lost, [ap[2] - ap[0], ap[2] - ap[1]], atol=1.0)
    assert column(found, "lost")[2] == "", "clean is what the others are measured by"


def test_without_corruptions_methods_are_measured_by_the_first() -> None:
    model = judged({"DSRC": 1.0, "late": 0.5})
    for own in model.sources[0].sets.values():
        assert isinstance(own, MemorySet)
        own._tables = {setup: frames for setup, frames in own._tables.items() if setup.condition.kind == "clean"}
    found = overview(model)
    assert [row[0].text for row in found.rows] == ["late", "DSRC"] and int(column(found, "lost")[0]) > 0


def test_methods_of_other_drives_are_not_measured_by_each_other() -> None:
    model = judged({"DSRC": 1.0, "late": 0.5}, drives=2)
    del model.sources[0].sets["late"], model.sources[1].sets["DSRC"]
    found = overview(model)
    lost = {row[0].text: row[found.head.index("lost")].text for row in found.rows}
    assert lost["clean · DSRC"] == lost["clean · late"] == ""
    assert all(lost[f"{kind} · {method}"] for kind in ("fog 3", "snow 3") for method in ("DSRC", "late"))
    assert found.says[0].startswith("2 drives, 24 frames, 12 of them judged."), "6 frames of each drive"


def test_counts_and_precision_are_those_of_the_errors_over_all_drives() -> None:
    model = judged({"DSRC": 1.0, "late": 0.8}, drives=2)
    found = overview(model)
    assert len(found.rows) == 6 and found.says[0].startswith(
        "2 drives, 24 frames, 12 of them judged. Score ≥ 0.3, IoU ≥ 0.5."
    )
    for row in found.rows:
        named = dict(zip(found.head, row, strict=True))
        label, method = row[0].text.split(" · ")
        kind = label.split()[0]
        counts = [
            model.index(ReviewState(drive=drive, methods=(method,), corruption=kind)).counts(0.3, 0.5)
            for drive in (0, 1)
        ]
        own = [one[method] for one in counts]
        assert named["missed"].text == str(sum(one.fn for one in own))
        assert named["false"].text == str(sum(one.fp for one in own))


def test_every_link_opens_the_worst_error_of_its_cell() -> None:
    model = judged({"DSRC": 1.0, "late": 0.8}, drives=2)
    found = overview(model)
    opened = 0
    for row in found.rows:
        for name, cell in zip(found.head, row, strict=True):
            if cell.opens is None:
                continue
            state, pose, wrong = read_link(write_link(model, cell.opens, None), model, ReviewState())
            assert not wrong and pose is None and state == cell.opens
            errors = model.index(replace(state, listed="all")).errors(0.3, 0.5)
            if name in ("missed", "false"):
                losses = [
                    float(every.loss[every.kind == ("missed", "false").index(name)].max(initial=0.0))
                    for every in (model.index(replace(state, drive=drive)).errors(0.3, 0.5) for drive in (0, 1))
                ]
                rows = errors.row == state.frame
                if name == "missed":
                    rows &= (errors.object_id == state.object_id) & (errors.kind == 0)
                else:
                    rows &= (errors.rank == state.detection) & (errors.kind == 1)
                assert errors.loss[rows].max() == max(losses)
                opened += 1
    assert opened == 12


def test_runs_without_detections_labels_or_errors_say_so(drive: FakeDrive, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "No detections: nothing is judged" in overview(ReviewModel([drive])).says[0]
    model = ReviewModel([drive], FakeDetector())
    assert overview(model).says == ("1 drive, 12 frames. Nothing is detected so far.",)
    table = draw_table(1, frames=2, skill=1.0)
    perfect = replace(table, boxes=table.truth, score=np.ones(len(table.truth), np.float32), found=table.truths)
    own = MemorySet("perfect")
    for one in perfect.frames():
        own.put(int(one.position[0]), one)
    model.sources[0].sets = {"perfect": own}
    found = overview(model)
    assert found.says[1] == "No errors: all objects are found, and nothing else."
    assert column(found, "worst") == ["none"] and [row[0].text for row in found.rows] == ["clean"]
    monkeypatch.setattr(DriveSource, "labelled", False)
    assert "No labels: detections are shown, and nothing is judged" in overview(model).says[0]


def test_a_damaged_cell_is_one_line_and_the_others_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    run = MemorySet.run

    def damaged(self: MemorySet, setup: Setup) -> DetectionTable:
        if setup.condition.kind == "fog":
            raise DataError("cells/0.npz: cell: expected a whole one, found a damaged one")
        return run(self, setup)

    monkeypatch.setattr(MemorySet, "run", damaged)
    found = overview(judged({"DSRC": 1.0}))
    assert found.says[-1] == "cells/0.npz: cell: expected a whole one, found a damaged one"
    assert [row[0].text for row in found.rows] == ["snow 3", "clean"]


def test_a_campaign_is_shown_as_outcomes_by_fault() -> None:
    class Driven(Source):
        kind, labelled = "episode", True

        def __init__(self, name: str, fault: str, line: EpisodeTimeline) -> None:
            super().__init__(name)
            self.fault, self.line = fault, line

        def __len__(self) -> int:
            return 3

        def timeline(self) -> EpisodeTimeline:
            return self.line

    def episode(name: str, fault: str, outcome: str, contact: int | None, speed: float, brake: float) -> Driven:
        wanted = np.array([0.0, -brake, 0.0])
        line = EpisodeTimeline(np.arange(3.0), np.zeros(3), wanted, wanted, contact, outcome, "", speed)
        return Driven(name, fault, line)

    episodes = [
        episode("a", "clean", "arrived", None, 9.0, 2.0),
        episode("b", "fog 4", "crashed", 2, 5.0, 8.0),
        episode("c", "fog 4", "crashed", 1, 11.0, 8.0),
        episode("d", "fog 4", "arrived", None, 9.0, 3.0),
        episode("e", "clean", "arrived", None, 9.0, 6.0),
    ]
    model = ReviewModel(episodes)
    found = overview(model)
    assert found.head == ("", "crashed", "arrived")
    assert [[cell.text for cell in row] for row in found.rows] == [["fog 4", "2", "1"], ["clean", "0", "2"]]
    fastest, hardest = found.rows[0][1].opens, found.rows[1][2].opens
    assert fastest is not None and (fastest.drive, fastest.frame) == (2, 1)
    assert hardest is not None and (hardest.drive, hardest.frame) == (4, 1)
    assert found.rows[1][1].opens is None, "nothing crashed on clean sweeps"
