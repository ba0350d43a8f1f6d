"""What an ego hears in single frames: lies in points and boxes, and boxes as ETSI's messages."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.drives import open_drive
from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.data.sample import Sample
from dsrc.evaluation.config import read_benchmark, single_defence
from dsrc.evaluation.detect import Method, MethodResult, evaluate_drive
from dsrc.evaluation.listener import fabricated, lies_in
from dsrc.faults.condition import frame_condition
from dsrc.models.settings import ModelSettings
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sensors.corruptions import Condition, drive_seed
from sim.boxes import concatenate
from sim.errors import SettingsError
from sim.radio import PRESETS
from tests.commands import dsrc
from tests.dsrc.training.drive import frame, write_drive
from tests.paths import ROOT
from tests.test_readme import commands_of

GRID = GridSpec(range_m=(-51.2, -25.6, -3, 51.2, 25.6, 1.8))
GHOST = "ghost:1,ahead_m=9"


class Annotators:
    """Agents that each tell the true boxes on which they have points."""

    settings = ModelSettings(fusion="late", grid=GRID)

    def detect_each(self, sample: Sample) -> list[Detections]:
        return [Detections(boxes, np.full(len(boxes), 0.9, np.float32)) for boxes in sample.agent_boxes]

    def joined(self, parts: list[Detections]) -> Detections:
        boxes = concatenate([part.boxes for part in parts])
        _, first = np.unique(np.round(boxes.array[:, :2]), axis=0, return_index=True)
        return Detections(boxes[first], np.full(len(first), 0.9, np.float32))

    def detect(self, sample: Sample) -> Detections:
        return self.joined(self.detect_each(sample))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("drives"), 3) / "made_up"


def heard(drive: Path, fault: str = "", channel: str = "", **how: object) -> MethodResult:
    condition = frame_condition(fault, "test") if fault else Condition()
    method = Method("a", Annotators(), channel=PRESETS[channel] if channel else None, **how)
    return evaluate_drive(open_drive(drive), [0, 1, 2], {condition: [method]}, seed=0)[condition, "a"]


def test_a_lie_in_boxes_is_one_false_box_of_each_liar_and_every_frame(drive: Path) -> None:
    honest, lie = heard(drive), heard(drive, GHOST)
    assert honest.told is None and (lie.told[:, 0] == 2).all() and (lie.told[:, 3] == 0).all()
    assert (lie.matches.detection_counts - honest.matches.detection_counts == 1).all(), "liars are of one mind"
    one = heard(drive, f"{GHOST} on -1")
    assert (one.told[:, [0, 3]] == 1).all()
    none = heard(drive, "ghost:0")
    assert none.matches.score.tobytes() == honest.matches.score.tobytes() and not none.told[:, 0].any()


def test_who_tells_of_nobody_leaves_the_ego_alone(drive: Path) -> None:
    silent, alone = heard(drive, "remove"), heard(drive, agents=1)
    assert silent.matches.detection_counts.tolist() == alone.matches.detection_counts.tolist()
    assert silent.matches.truth == alone.matches.truth, "the truth stays"


@pytest.mark.parametrize("messages", ["", "cpm"])
def test_a_lie_is_sent_with_its_own_bytes(drive: Path, messages: str) -> None:
    sent = [
        heard(drive, text, "ideal", messages=messages).traffic[:, 0]
        for text in ("", GHOST, f"{GHOST} on -1", "false_pose:4", "remove")
    ]
    assert (sent[1] == sent[0] + 2 * 35).all() and (sent[2] == sent[0] + 35).all() and (sent[3] == sent[0]).all()
    assert (sent[4] == 2 * 156).all(), "a message of nobody"


def test_rates_are_of_messages(drive: Path) -> None:
    rows = [heard(drive, f"ghost:{share},ahead_m=9").told[:, 0].sum() for share in (0.0, 0.5, 1.0)]
    assert rows[0] == 0 and 0 < rows[1] < rows[2] == 6


def test_it_is_known_of_each_frame_who_lied_and_where(drive: Path) -> None:
    text, reader = "ghost:0.5,ahead_m=9", open_drive(drive)
    told, condition, seed = heard(drive, text).told[:, 0], frame_condition(text, "test"), drive_seed(0, "made_up")
    assert set(told) != {0.0} and told.sum() < 6
    for number, count in enumerate(told):
        now = reader.read(number)
        ego, *helpers = (agent.agent_id for agent in now.agents)
        lied = lies_in(now, condition, seed, helpers, {})
        assert len(lied) == count and lies_in(now, condition, seed, helpers, dict.fromkeys(helpers)) == {}
        own = now.truth.center[now.truth.object_id == ego][0, :2]
        assert all(
            np.linalg.norm(lie.ghosts.center[0, :2] - own) == pytest.approx(9.0, abs=0.02) for lie in lied.values()
        )
    gone = lies_in(now, frame_condition("remove on -1", "test"), seed, helpers, {})
    assert list(gone) == [-1] and set(gone[-1].removed) <= set(now.truth.object_id.tolist())


def test_messages_tell_the_same_as_boxes_to_the_centimetre_and_less_with_mitigation(drive: Path) -> None:
    boxes, cpm, less = (heard(drive, channel="ideal", messages=kind) for kind in ("boxes", "cpm", "cpm-dynamics"))
    exact, coarse = boxes.table.boxes, cpm.table.boxes
    assert exact.shape == coarse.shape
    off = np.abs(exact - coarse)
    assert 0.0 < off[:, :2].max() < 0.02 and off[:, 3:6].max() < 0.06
    counts = boxes.traffic[:, 0]
    assert (cpm.traffic[:, 0] == counts).all() and (less.traffic[:, 0] < counts).all()
    assert less.matches.detection_counts.tolist() == cpm.matches.detection_counts.tolist(), "somebody told of each"


def test_a_message_of_the_frame_before_has_the_objects_of_that_frame(drive: Path) -> None:
    late = heard(drive, "delay:0.1", "ideal", messages="cpm")
    alone, now = heard(drive, agents=1), heard(drive, messages="cpm")
    assert late.matches.detection_counts[0] == alone.matches.detection_counts[0], "nothing has arrived yet"
    assert late.matches.detection_counts[2] > alone.matches.detection_counts[2]
    assert late.table.boxes[-5:].tobytes() != now.table.boxes[-5:].tobytes()


def test_points_of_a_lie_lie_on_the_ghost_along_the_helpers_own_rays() -> None:
    before = frame(0)
    after = fabricated(before, frame_condition("ghost:1,ahead_m=12 on 1001", "test"), seed=0)
    assert [a.sweep is b.sweep or np.array_equal(a.sweep.points, b.sweep.points)
            for a, b in zip(before.agents, after.agents, strict=True)] == [True, False, True]  # fmt: skip
    old, new = (one.agent(1001).sweep for one in (before, after))
    moved = (old.points != new.points).any(axis=1)
    ways = [points[moved] / np.linalg.norm(points[moved], axis=1)[:, None] for points in (old.points, new.points)]
    np.testing.assert_allclose(*ways, atol=1e-5)
    ego = before.truth[before.truth.object_id == 1000]
    ghost = replace(ego, center=ego.center + np.array([12.0, 0.0, 0.0]), size=np.array([[4.5, 1.9, 1.5]]))
    inside, _ = points_in_boxes(ghost, new.points[moved], new.world_from_lidar, 0.05)
    assert moved.sum() > 10 and len(inside) == moved.sum()


def test_removed_road_users_have_no_point_and_a_false_pose_moves_the_sweep_alone() -> None:
    before = frame(0)
    gone = fabricated(before, frame_condition("remove", "test"), seed=0)
    for agent in gone.agents[1:]:
        ids = np.unique(agent.sweep.object_id)
        assert not (ids >= 1000).any() and len(agent.sweep) > 0
    assert np.array_equal(gone.agents[0].sweep.points, before.agents[0].sweep.points), "the ego does not lie"
    moved = fabricated(before, frame_condition("false_pose:0,aside_m=4 on -1", "test"), seed=0)
    apart = [np.linalg.norm(a.sweep.world_from_lidar[:3, 3] - b.sweep.world_from_lidar[:3, 3])
             for a, b in zip(before.agents, moved.agents, strict=True)]  # fmt: skip
    np.testing.assert_allclose(apart, [0.0, 0.0, 4.0], atol=1e-9)


@pytest.mark.parametrize("text", ["motion", "trust", "free-space,trust"])
def test_a_defence_that_needs_time_is_refused(text: str) -> None:
    with pytest.raises(SettingsError, match="agreement or free-space: frames are judged one by one"):
        single_defence(text, "evaluate")


def words_of(page: str, *begin: str) -> Sequence[str]:
    return next(words for words in commands_of(ROOT / "docs" / page) if tuple(words[: len(begin)]) == begin)


@pytest.mark.slow
def test_the_command_of_the_page_makes_its_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dsrc").symlink_to(ROOT / "dsrc")
    made = words_of("attacks.md", "generate")
    assert dsrc(*made[:2], "--out", "data/attacks", "--frames", "2", "--seed", "903").returncode == 0
    ran = dsrc(*words_of("attacks.md", "evaluate"))
    assert ran.returncode == 0, ran.stderr
    assert "Attacks and defences" in ran.stdout, ran.stdout
    rows = json.loads((tmp_path / "runs/attacks-in-frames/results.json").read_text())["rows"]
    told = {(row["condition"], row["method"]): row["metrics"] for row in rows}
    for message in ("boxes", "cpm-dynamics"):
        lie = told["ghost:1", f"small-dsrc, {message}, free-space"]
        assert 0 < lie["false_refused"] <= lie["false_told"]
        assert told["ghost:1", f"small-dsrc, {message}"]["false_refused"] == 0


def test_the_plan_of_the_page_is_whole() -> None:
    plan = read_benchmark(ROOT / "studies/attacks_in_frames.toml")
    assert {method.use.get("messages") for method in plan.methods} >= {None, "boxes", "cpm", "cpm-dynamics"}
