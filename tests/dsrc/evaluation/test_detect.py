import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsrc.data.drives import list_drives, open_drive
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.sample import OPENCOOD_RANGE_M, Sample, SampleRequest, first_agents, make_sample
from dsrc.detectors.classes import OwnDetector
from dsrc.evaluation.detect import Method, corrupted, frame_positions, warn_of_slow_drives
from dsrc.evaluation.results import find_row
from dsrc.ops.detections import Detections
from sensors.corruptions import CORRUPTIONS, PAPER_SIX, Condition, corruption_kinds, drive_seed
from sensors.frame import Frame
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError
from sim.radio import PRESETS
from tests.dsrc.data import goldens
from tests.dsrc.data.toy import toy_frame
from tests.dsrc.evaluation.fakes import GRID, PointCounter, detect_all, halve, write_drives

KINDS = {"fog": None, "snow": None}
registered = CORRUPTIONS


@pytest.fixture(autouse=True)
def _corruptions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sensors.corruptions.condition.CORRUPTIONS", KINDS)
    monkeypatch.setattr("sensors.corruptions.condition.corrupt_frame", halve)


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_drives(tmp_path_factory.mktemp("drives"))


def test_methods_and_conditions_have_a_row_each_and_two_summaries(drives: list[Path]) -> None:
    rows = detect_all([Method("a", PointCounter()), Method("b", PointCounter(9))], drives, ("all",))
    labels = [(row.condition, row.method) for row in rows]
    assert labels == [
        ("clean", "a"), ("clean", "b"), ("fog", "a"), ("fog", "b"), ("snow", "a"), ("snow", "b"),
        ("mean_ap", "a"), ("mce", "a"), ("mean_ap", "b"), ("mce", "b"),
    ]  # fmt: skip
    assert [row.severity for row in rows[:3]] == [0, 0, 3]
    assert all(row.frames == 6 for row in rows)
    assert all(row.seconds_per_frame > 0 for row in rows[:6])


def test_truth_stays_that_of_the_clean_frame(drives: list[Path]) -> None:
    rows = detect_all([Method("a", PointCounter(need=20))], drives, ("fog",), severity=5)
    clean, fog = find_row(rows, "a", "clean"), find_row(rows, "a", "fog")
    assert clean.truth == fog.truth > 0
    assert fog.detections < clean.detections
    mce, mean = find_row(rows, "a", "mce"), find_row(rows, "a", "mean_ap")
    ap, low = clean.metrics["ap_bev_50"], fog.metrics["ap_bev_50"]
    assert low < ap
    assert mce.metrics["ap_bev_50"] == pytest.approx((ap - low) / ap)
    assert mean.metrics["ap_bev_50"] == pytest.approx((ap + low) / 2)


def test_the_ego_alone_sees_one_cloud_and_is_judged_by_the_same_truth(drives: list[Path]) -> None:
    together, alone = PointCounter(need=90), PointCounter(need=90)
    rows = detect_all([Method("all", together), Method("ego", alone, agents=1)], drives, ("clean",))
    assert {len(s.clouds) for s in together.seen} == {3}
    assert {len(s.clouds) for s in alone.seen} == {1}
    assert rows[0].truth == rows[1].truth
    assert rows[1].metrics["ap_bev_50"] < rows[0].metrics["ap_bev_50"]
    assert len(rows) == 2


def test_judged_by_opencood_a_method_has_the_truth_that_opencood_has(tmp_path: Path) -> None:
    mini, expected = goldens.unpack_opv2v_mini(tmp_path), goldens.load("opv2v_mini_expected")
    theirs, inside = PointCounter(need=0), PointCounter(need=0)
    theirs.settings = SampleRequest(GRID, team_by="folders", keep_ego_box=True, truth_range_m=OPENCOOD_RANGE_M)
    rows = detect_all([Method("theirs", theirs), Method("ours", inside)], list_drives(mini))
    ids = [expected[f"test/{k}/object_ids"].tolist() for k in range(rows[0].frames)]
    assert [sample.boxes.object_id.tolist() for sample in theirs.seen] == ids
    assert rows[0].truth == rows[0].detections == sum(map(len, ids)) > rows[1].truth
    assert rows[0].metrics["ap_opencood_bev_70"] == 1.0


def test_each_method_is_judged_on_its_own_road_users_and_team_whoever_runs_beside_it(drives: list[Path]) -> None:
    def found(*settings: dict[str, Any]) -> list[list[tuple]]:
        methods = [Method(str(k), PointCounter(need=0)) for k in range(len(settings))]
        for method, more in zip(methods, settings, strict=True):
            method.detector.settings = SampleRequest(GRID, **more)
        detect_all(methods, drives, ("clean",))
        return [[(s.agent_ids, s.boxes.object_id.tolist()) for s in m.detector.seen] for m in methods]

    cases = [{"users": "vehicles"}, {"users": "vulnerable"}, {"comm_range_m": 27.0}, {"comm_range_m": 35.0}]
    alone = [found(case)[0] for case in cases]
    assert len({str(one) for one in alone}) == 3 and alone[0] == alone[3]  # the second car is 30 m away
    assert found(*cases) == alone and found(*reversed(cases)) == alone[::-1]


def test_a_helper_whose_pose_is_wrong_stays_in_range_and_what_it_sees_in_the_truth(
    drives: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def moved(frame: Frame, kind: str, severity: int, seed: int, family: str = "physical", **_: object) -> Frame:
        """Report the third agent, the roadside unit 21 m away, to be 10 m further off."""
        sweep = frame.agents[2].sweep
        pose = sweep.world_from_lidar.copy()
        pose[:2, 3] *= 1.5
        return frame.with_sweeps([*(a.sweep for a in frame.agents[:2]), replace(sweep, world_from_lidar=pose)])

    monkeypatch.setattr("sensors.corruptions.condition.corrupt_frame", moved)
    detector = PointCounter(need=0)
    detector.settings = SampleRequest(GRID, comm_range_m=25.0)
    detect_all([Method("a", detector)], drives, ("fog",))
    clean, wrong = detector.seen[::2], detector.seen[1::2]
    assert {sample.agent_ids for sample in detector.seen} == {(1000, -1)}
    for one, other in zip(clean, wrong, strict=True):
        assert one.boxes.object_id.tolist() == other.boxes.object_id.tolist()
        assert np.abs(one.ego_from_agent[1] - other.ego_from_agent[1]).max() > 5.0


def test_one_agent_is_the_ego_alone_and_more_agents_leave_the_truth(drives: list[Path]) -> None:
    frame = toy_frame(0)
    whole = make_sample(frame, None, GRID)
    alone, first = make_sample(frame, None, GRID, cooperative=False), first_agents(whole, 1)
    assert first.agent_ids == alone.agent_ids and len(first.clouds) == len(first.agent_boxes) == 1
    np.testing.assert_array_equal(first.clouds[0], alone.clouds[0])
    np.testing.assert_array_equal(first.ego_from_agent, alone.ego_from_agent)
    np.testing.assert_array_equal(first.boxes.array, alone.boxes.array)
    detectors = [PointCounter(need=60) for _ in range(3)]
    rows = detect_all([Method(str(k), d, agents=k) for k, d in enumerate(detectors, 1)], drives, ("clean",))
    assert [{len(s.clouds) for s in d.seen} for d in detectors] == [{1}, {2}, {3}]
    assert len({row.truth for row in rows}) == 1


def test_each_frame_is_corrupted_once_for_all_methods(drives: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def count(frame: Frame, kind: str, severity: int, seed: int, family: str, **_: object) -> Frame:
        calls.append((frame.index, kind, severity, seed, family))
        return halve(frame, kind, severity, seed)

    monkeypatch.setattr("sensors.corruptions.condition.corrupt_frame", count)
    one, two = PointCounter(), PointCounter()
    detect_all([Method("a", one), Method("b", two)], drives[:1], ("all",), severity=2, seed=7)
    own = drive_seed(7, "drive_0")
    assert sorted(calls) == [(i, kind, 2, own, "physical") for i in range(3) for kind in ("fog", "snow")]
    assert [a is b for a, b in zip(one.seen, two.seen, strict=True)] == [True] * 9
    assert one.seen[0].key == "drive_0/1000/000000"


@pytest.mark.parametrize(("who", "parsed"), [("all", "all"), ("ego", "ego"), ("1002,-1", (1002, -1))])
def test_a_condition_says_whose_sweeps_are_corrupted(
    monkeypatch: pytest.MonkeyPatch, who: str, parsed: str | tuple[int, int]
) -> None:
    seen = []
    monkeypatch.setattr(
        "sensors.corruptions.condition.corrupt_frame", lambda *_, corrupted_agents, **__: seen.append(corrupted_agents)
    )
    corrupted(toy_frame(0), Condition.of("fog", 5, agents=who), seed=3)
    assert seen == [parsed]


def test_two_runs_give_the_same_rows(drives: list[Path]) -> None:
    first, second = (detect_all([Method("a", PointCounter())], drives, ("all",), seed=1) for _ in range(2))
    assert first == second


def test_a_limit_spreads_the_frames_evenly(drives: list[Path]) -> None:
    detector = PointCounter()
    detect_all([Method("a", detector)], drives, ("clean",), limit=3)
    assert [s.key for s in detector.seen] == ["drive_0/1000/000000", "drive_0/1000/000002", "drive_1/1000/000002"]


def test_every_frame_is_counted_under_every_condition(drives: list[Path]) -> None:
    told = []
    detect_all([Method("a", PointCounter())], drives, ("all",), limit=2, count_frame=lambda: told.append(1))
    assert len(told) == 2 * 3


def test_detections_beyond_the_range_are_not_judged(drives: list[Path]) -> None:
    class Beyond(PointCounter):
        def detect(self, sample: Sample) -> Detections:
            inside = super().detect(sample)
            far = Boxes.from_array([[51.0, 0, 0, 4, 2, 1.5, 0]])
            array = np.concatenate([far.array, inside.boxes.array])
            return Detections(Boxes.from_array(array), np.concatenate([[1.0], inside.score]).astype(np.float32))

    rows = detect_all([Method("a", Beyond()), Method("b", PointCounter())], drives, ("clean",))
    assert rows[0].metrics == rows[1].metrics


def test_a_blind_detector_gets_zeros_and_no_mce(drives: list[Path]) -> None:
    rows = detect_all([Method("a", PointCounter(need=10**6))], drives, ("fog",))
    assert find_row(rows, "a", "clean").metrics["ap_bev_50"] == 0.0
    assert math.isnan(find_row(rows, "a", "mce").metrics["ap_bev_50"])


def test_kinds_come_in_the_order_of_the_registry() -> None:
    assert corruption_kinds(("snow", "fog")) == ("fog", "snow")
    assert corruption_kinds(("all", "fog")) == ("fog", "snow")
    assert corruption_kinds(("clean",)) == ()


def test_the_papers_six_are_six_and_all_are_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sensors.corruptions.condition.CORRUPTIONS", registered)
    assert corruption_kinds(("paper_six",)) == PAPER_SIX
    assert corruption_kinds(("all",)) == tuple(registered)
    assert "pose_error" in corruption_kinds(("paper_six", "pose_error"))
    with pytest.raises(SettingsError, match="'pose_error' has no published model"):
        corruption_kinds(("pose_error",), "paper")


def test_without_a_frame_there_is_nothing_to_evaluate() -> None:
    with pytest.raises(DataError, match="at least one frame"):
        frame_positions([], None)


def test_channels_are_counted_and_an_ideal_one_changes_no_number(drives: list[Path]) -> None:
    detector = PointCounter()
    methods = [Method("direct", detector)] + [Method(n, detector, channel=PRESETS[n]) for n in ("ideal", "paper")]
    rows = {row.method: row for row in detect_all(methods, drives, ("clean",))}
    assert rows["ideal"].metrics == rows["direct"].metrics
    assert (rows["ideal"].message_age_s, rows["ideal"].heard) == (0.0, 1.0)
    assert rows["direct"].bytes_per_frame is None
    # The first of three frames has nothing to hear yet.
    assert rows["paper"].heard == pytest.approx(2 / 3) and rows["paper"].message_age_s == pytest.approx(0.1)
    assert rows["paper"].bytes_per_frame == 2 * 132_500


def test_frames_before_the_first_of_a_limit_are_heard_too(drives: list[Path]) -> None:
    row = detect_all([Method("paper", PointCounter(), channel=PRESETS["paper"])], drives[:1], ("clean",), limit=2)[0]
    assert row.heard == 0.5  # the first frame of the drive and the last


def test_a_channel_over_frames_far_apart_is_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for index in range(2):
        frame = toy_frame(index)
        write_frame(tmp_path / "slow", replace(frame, time_s=10.0 * index))
    warn_of_slow_drives([open_drive(tmp_path / "slow")])
    assert "slow: its frames are 10 s apart" in caplog.text


class Failing(PointCounter):
    """Detector of one's own that raises."""

    def __init__(self, error: BaseException) -> None:
        super().__init__()
        self.error = error

    def detect(self, sample: Sample) -> Detections:
        raise self.error


@pytest.mark.parametrize("error", [SystemExit(0), ValueError("no\nboxes")])
def test_a_failure_of_ones_own_detector_is_one_line_with_the_frame(drives: list[Path], error: BaseException) -> None:
    own = OwnDetector(Failing(error), "module:Failing")
    with pytest.raises(DataError, match=f"frame 0: detector 'Failing': .*{type(error).__name__}: ") as caught:
        detect_all([Method("a", own)], drives)
    assert "\n" not in str(caught.value)


def test_a_failure_of_a_detector_of_ours_is_a_fault(drives: list[Path]) -> None:
    with pytest.raises(ZeroDivisionError):
        detect_all([Method("a", Failing(ZeroDivisionError()))], drives)
