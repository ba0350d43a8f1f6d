"""Who helped, as a page has it: boxes by the agent to whom their score is due, and shares on the card."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsrc.__main__ import main
from dsrc.evaluation.sharing.stored import FILE, SharedBox, StoredShares, read_shares
from dsrc.review.model import ReviewModel, open_model
from dsrc.review.page.page import Shown
from dsrc.review.page.panels import CONTROLS
from dsrc.review.sources.base import Setup
from dsrc.review.sources.opening import open_sources
from dsrc.review.sources.results import SharedSource
from dsrc.review.state import ReviewState
from dsrc.review.texts import selection_report, summary
from dsrc.review.view import FALSE_NEGATIVES, OTHER_TRUTH, TRUE_POSITIVES
from sensors.corruptions import Condition
from sim.boxes import Boxes
from sim.errors import DataError
from sim.geometry import invert
from tests.dsrc.evaluation.small import write_detector, write_drives
from tests.dsrc.review.conftest import FakeDetector, FakeDrive, cells, street_frame
from tests.dsrc.review.shared import shared_street


@pytest.fixture
def model() -> ReviewModel:
    return ReviewModel([SharedSource(FakeDrive(), shared_street())], FakeDetector())


def ids_of(boxes: Boxes) -> list[int]:
    return boxes.object_id.tolist()


def test_boxes_are_of_the_agent_to_whom_most_of_their_score_is_due(model: ReviewModel) -> None:
    view = model.view(ReviewState())
    assert [agent.agent_id for agent in view.agents] == [1000, 1002, -1]
    assert [ids_of(boxes) for boxes in view.help.found] == [[1001], [1003], [1004]]
    assert [len(boxes) for boxes in view.help.made] == [0, 1, 0]
    assert (ids_of(view.help.missed), ids_of(view.help.harmed)) == ([1005], [1004])
    # Boxes lie where the objects are, and what has no shares is drawn as what is not evaluated.
    truth = street_frame(0).truth
    for row, boxes in enumerate(view.help.found):
        place = truth.center[[1, 3, 4][row]] - model.origin(0)
        np.testing.assert_allclose(boxes.center[0], place, atol=1e-3)
    assert ids_of(view.layers[OTHER_TRUTH]) == [1000, 1002]
    assert not len(view.layers[TRUE_POSITIVES]) and "coloured by who helped most" in summary(view)
    judged = model.view(ReviewState(boxes_by="verdict"))
    assert judged.help is None and len(judged.layers[TRUE_POSITIVES]) and len(judged.layers[FALSE_NEGATIVES])


def test_the_card_has_the_shares_of_what_is_selected(model: ReviewModel) -> None:
    for by in ("shares", "verdict"):
        details = model.view(ReviewState(object_id=1004, boxes_by=by)).details
        assert [(one.agent, one.share, one.without) for one in details.shares] == [
            ("ego", 0.3, 0.5),
            ("helper 1002", -0.2, 0.7),
            ("roadside unit 1", 0.4, 0.1),
        ]
        card = selection_report(details)
        assert cells(card)[-4:-2] == [["ego alone", "0.30", ""], ["helper 1002", "-0.20", "0.70"]]
        assert cells(card)[-1] == ["all", "0.50", ""]
    assert model.view(ReviewState(object_id=1000)).details.shares == ()
    ghost = model.method(ReviewState())
    rank = len(model._detections(ReviewState(), ghost).boxes) - 1
    found = model.view(ReviewState(detection=rank, boxes_by="verdict")).details
    assert found.verdict == "false" and [one.share for one in found.shares] == [0.1, 0.3]
    assert "who helped" not in selection_report(replace(found, shares=()))
    hit = model.view(ReviewState(detection=0, boxes_by="verdict")).details
    assert hit.verdict == "true" and sum(one.share for one in hit.shares) == pytest.approx(0.8)


def test_frames_without_shares_say_where_there_are_some(
    model: ReviewModel, fake_fog: list[tuple[int, str, int]]
) -> None:
    assert (
        "No shares in this frame of this ego; the first with some is in row 0."
        in model.view(ReviewState(frame=1)).notice
    )
    other = model.view(ReviewState(ego_id=1002))
    assert other.help is None and "of this ego" in other.notice
    fog = model.view(ReviewState(corruption="fog", severity=4))
    assert fog.help is None and fog.notice == "No shares in fog 4; there are in clean, fog 2."
    (control,) = [one for one in CONTROLS if one.field == "boxes_by"]
    assert control.shown(Shown(model, ReviewState())) and not control.shown(
        Shown(ReviewModel([FakeDrive()]), ReviewState())
    )


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("shares")
    write_drives(root / "test", drives=1)
    net = write_detector(root / "net.pt", "attfuse")
    main(["shares", str(root / "test"), "--checkpoint", str(net), "--out", str(root / "out"), "--corruption", "fog"])
    return root


def test_a_folder_of_shares_opens_as_its_drives(done: Path, tmp_path: Path) -> None:
    (source,) = open_sources(done / "out")
    assert (source.name, len(source), source.sets) == ("drive_0", 2, {})
    content = json.loads((done / "out" / FILE).read_text())
    stored = source.shares(0, Setup(Condition("fog", 3)))
    frame = next(one for one in content["frames"] if one["condition"] == "fog" and one["frame"] == stored.frame)
    assert [dict(one.share) for one in stored.boxes] == [
        {int(agent): share for agent, share in one["share"].items()} for one in frame["boxes"]
    ]
    # True boxes are those of the drive.
    recorded = source.read(0)
    lidar = recorded.agent(stored.ego_id).sweep.world_from_lidar
    truth = recorded.truth.transform(invert(lidar))
    for one in stored.boxes:
        if one.object_id != -1:
            np.testing.assert_allclose(one.box, truth.array[truth.object_id == one.object_id][0], atol=2e-3)
    model = open_model(done / "out", done / "net.pt")
    assert model.methods(0) == ["net"] and model.view(ReviewState()).help is not None
    shutil.copytree(done / "out", tmp_path / "out")
    shutil.move(shutil.copytree(done / "test", tmp_path / "other"), tmp_path / "moved")
    assert len(open_sources(tmp_path / "out", tmp_path / "moved")) == 1


def test_wrong_shares_are_one_line(done: Path, tmp_path: Path) -> None:
    content = json.loads((done / "out" / FILE).read_text())

    def told(**changes: Any) -> str:
        (tmp_path / FILE).write_text(json.dumps({**content, **changes}))
        with pytest.raises(DataError) as caught:
            open_sources(tmp_path)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert f"{FILE}: drives: expected names that differ, found none" in told(drives=[])
    assert "names that differ, found drive_0, drive_0" in told(drives=content["drives"] * 2)
    assert "expected the drive that was evaluated" in told(drives=[{**content["drives"][0], "data": "0" * 64}])
    gone = {**content["drives"][0], "path": str(tmp_path / "gone")}
    assert f"{FILE}: drives: gone: " in told(drives=[gone])
    first = content["frames"][0]
    assert f"{FILE}: frames[0].boxes[0].share" in told(frames=[{**first, "boxes": [{**first["boxes"][0], "share": 1}]}])
    assert "the same agents" in told(frames=[{**first, "boxes": [{**first["boxes"][0], "without": {}}]}])
    (tmp_path / FILE).write_text("{")
    with pytest.raises(DataError, match=f"{FILE}: not a readable JSON file"):
        open_sources(tmp_path)


def test_what_is_read_is_what_was_written(done: Path) -> None:
    stored = read_shares(done / "out")
    assert isinstance(stored, StoredShares) and all(isinstance(box, SharedBox) for box in stored.frames[0].boxes)
    assert {stored.condition(frame.condition) for frame in stored.frames} == {Condition(), Condition("fog", 3)}
    for frame in stored.frames:
        for box in frame.boxes:
            assert sum(box.share.values()) == pytest.approx(box.team, abs=1e-9)
