"""Shares sum to what the team finds; who changes nothing has none, and who harms has less than none."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from dsrc.__main__ import main
from dsrc.data.sample import Sample, SampleRequest
from dsrc.evaluation.sharing import drives
from dsrc.evaluation.sharing.cells import ShareRow
from dsrc.evaluation.sharing.drives import frames_looked_at, share_drives
from dsrc.evaluation.sharing.report import share_bars, summaries
from dsrc.evaluation.sharing.shares import Shares, shapley, share_sample
from dsrc.ops.detections import Detections
from dsrc.options.detection import Sharing
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError
from tests.dsrc.evaluation.fakes import GRID
from tests.dsrc.evaluation.small import write_detector, write_drives

values = arrays(np.float64, (16, 3), elements=st.floats(-1, 1))


def test_the_glove_game_has_its_known_values() -> None:
    # One left glove, two right ones; a pair is worth 1 (Shapley and Shubik, 1969).
    worth = [0, 0, 0, 1, 0, 1, 0, 1]
    np.testing.assert_allclose(shapley(np.array(worth)), [2 / 3, 1 / 6, 1 / 6])


@given(values)
def test_shares_sum_to_the_gain(v: np.ndarray) -> None:
    np.testing.assert_allclose(shapley(v).sum(0), v[-1] - v[0], atol=1e-12)


@given(values, st.integers(0, 3))
def test_who_changes_nothing_has_none(v: np.ndarray, i: int) -> None:
    rows = np.arange(16)
    mute = v[rows & ~(1 << i)]
    assert np.abs(shapley(mute)[i]).max() < 1e-12


@given(values)
def test_two_that_do_the_same_have_the_same(v: np.ndarray) -> None:
    swapped = np.array([(row & 12) | (row & 1) << 1 | (row & 2) >> 1 for row in range(16)])
    alike = (v + v[swapped]) / 2
    found = shapley(alike)
    np.testing.assert_allclose(found[0], found[1], atol=1e-12)


def box_at(x: float) -> list[float]:
    return [x, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]


def boxes_at(*places: float) -> Boxes:
    return Boxes.from_array(np.array([box_at(x) for x in places]).reshape(-1, 7))


class Says:
    """Detector of what a function of the team says: places along x and scores."""

    settings = SampleRequest(GRID)

    def __init__(self, says: Callable[[set[int]], dict[float, float]]) -> None:
        self.says = says

    def detect(self, sample: Sample) -> Detections:
        said = self.says(set(sample.agent_ids))
        order = sorted(said, key=said.get, reverse=True)
        return Detections(boxes_at(*order), np.array([said[x] for x in order], np.float32))


def shares_of(
    says: Callable[[set[int]], dict[float, float]],
    agents: tuple[int, ...] = (1, 2, 3),
    heard: tuple[int, ...] | None = None,
) -> Shares:
    """Shares in two true boxes, at 10 and 20 m."""
    heard = agents if heard is None else heard
    empty = np.zeros((0, 4), np.float32)
    poses = np.tile(np.eye(4), (len(heard), 1, 1))
    truth = replace(boxes_at(10.0, 20.0), object_id=np.array([7, 8]))
    sample = Sample("x", heard, (empty,) * len(heard), poses, truth, (truth,) * len(heard))
    return share_sample(Says(says), sample, agent_ids=agents)


def test_what_one_agent_alone_makes_possible_is_its_own() -> None:
    shares = shares_of(lambda team: {10.0: 0.5} | ({20.0: 0.8} if 2 in team else {}))
    np.testing.assert_allclose(shares.share, [[0.5, 0.0], [0.0, 0.8], [0.0, 0.0]], atol=1e-7)
    assert shares.needed.tolist() == [[False, False], [False, True], [False, False]]
    assert not shares.prevented.any() and shares.true.all()


def test_what_either_finds_is_shared_and_what_both_are_needed_for_too() -> None:
    either = shares_of(lambda team: {20.0: 0.6} if team & {2, 3} else {})
    np.testing.assert_allclose(either.share[:, 1], [0.0, 0.3, 0.3], atol=1e-7)
    assert not either.needed.any()
    both = shares_of(lambda team: {20.0: 0.6} if team >= {2, 3} else {})
    np.testing.assert_allclose(both.share[:, 1], [0.0, 0.3, 0.3], atol=1e-7)
    assert both.needed[1:, 1].all()


def test_who_hides_an_object_harms() -> None:
    shares = shares_of(lambda team: {} if 3 in team else {10.0: 0.9})
    np.testing.assert_allclose(shares.share[:, 0], [0.9, 0.0, -0.9], atol=1e-6)
    assert shares.prevented[:, 0].tolist() == [False, False, True]
    np.testing.assert_allclose(shares.share.sum(0), shares.team, atol=1e-12)


def test_a_false_detection_is_of_who_made_it() -> None:
    shares = shares_of(lambda team: {10.0: 0.9} | ({30.0: 0.4, 40.0: 0.2} if 2 in team else {40.0: 0.1}))
    assert shares.true.tolist() == [True, True, False, False]
    np.testing.assert_allclose(shares.share[:, 2], [0.0, 0.4, 0.0], atol=1e-7)
    np.testing.assert_allclose(shares.share[:, 3], [0.1, 0.1, 0.0], atol=1e-7)
    assert shares.needed[:, 2].tolist() == [False, True, False]


def test_who_is_not_heard_has_no_share() -> None:
    shares = shares_of(lambda team: {10.0: 0.1 * len(team)}, agents=(1, 2, 3), heard=(1, 3))
    assert shares.heard.tolist() == [True, False, True]
    np.testing.assert_allclose(shares.share[:, 0], [0.1, 0.0, 0.1], atol=1e-7)
    np.testing.assert_allclose(shares.without[:, 0], [0.2, 0.2, 0.1], atol=1e-7)


def test_an_ego_alone_has_all() -> None:
    shares = shares_of(lambda team: {10.0: 0.7}, agents=(1,))
    np.testing.assert_allclose(shares.share, [[0.7, 0.0]], atol=1e-7)


def test_a_detection_that_overlaps_too_little_is_false() -> None:
    # Boxes of 4 m that are 2 m apart overlap by a third.
    shares = shares_of(lambda team: {12.0: 0.7})
    assert shares.team[0] == 0.0 and not shares.true[2]
    with pytest.raises(SettingsError, match="iou: expected more than 0"):
        share_sample(Says(dict), None, iou=0.0)
    with pytest.raises(SettingsError, match="agents: expected at most 6, found 7"):
        shares_of(lambda team: {}, agents=tuple(range(7)))


def false_row(frame: int, share: float) -> ShareRow:
    """Share of the ego in the one false box of a frame."""
    place = dict.fromkeys(("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad"), 1.0)
    return ShareRow(
        "drive", "clean", frame, 0, -1, **place, ego_id=1, agent_id=1, agent="ego", heard=True, distance_m=9.0,
        points=0, share=share, team=share, without=share,
    )  # fmt: skip


def test_false_detections_are_shared_by_all_frames_that_were_looked_at() -> None:
    heights = [bar.get_height() for bar in share_bars([false_row(3, 0.5)], frames=10).axes[1].patches]
    assert max(heights) == pytest.approx(0.05)


def test_frames_without_a_box_are_counted(world: Path) -> None:
    config = Sharing(checkpoint=world / "net.pt", data=world / "test", out=world / "none")
    every = frames_looked_at(config)
    assert every > 1 == frames_looked_at(msgspec.structs.replace(config, frames=1))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("shares")
    write_drives(root / "test", drives=1)
    write_detector(root / "net.pt", "attfuse")
    return root


def test_the_command_writes_a_line_per_agent_and_box_and_prints_a_table(
    world: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = world / "out"
    options = ["--corruption", "beam_missing", "--channel", "its-g5-6", "--iou", "0.3"]
    main(["shares", str(world / "test"), "--checkpoint", str(world / "net.pt"), "--out", str(out), *options])
    assert "Who helped" in capsys.readouterr().out
    lines = list(csv.DictReader((out / "shares.csv").read_text().splitlines()))
    assert {line["condition"] for line in lines} == {"clean", "beam_missing"}
    assert {line["agent"] for line in lines} >= {"ego", "vehicle"}
    sums: dict[tuple[str, ...], float] = {}
    for line in lines:
        key = tuple(line[name] for name in ("condition", "frame", "box", "team"))
        sums[key] = sums.get(key, 0.0) + float(line["share"])
        if line["heard"] == "False":
            assert (line["points"], float(line["share"])) == ("0", 0.0)
    assert max(float(key[-1]) for key in sums) > 0.3
    for key, total in sums.items():
        assert total == pytest.approx(float(key[-1]), abs=1e-9)
    content = json.loads((out / "shares.json").read_text())
    assert content["provenance"]["settings"]["iou"] == 0.3
    assert sum(len(frame["boxes"]) for frame in content["frames"]) == len(sums)
    with Image.open(out / "shares.png") as image:
        assert image.width > 800


def test_shares_are_the_same_again_and_limits_hold(world: Path) -> None:
    config = Sharing(checkpoint=world / "net.pt", data=world / "test", out=world / "again", frames=1)
    steps = []
    rows = share_drives(config, progress=lambda done, total: steps.append((done, total)))
    assert rows == share_drives(config) and steps == [(0, 1), (1, 1)]
    listed = summaries(rows)
    assert sum(one.pairs for one in listed) == sum(row.object_id != -1 for row in rows)
    assert sum(one.share for one in listed) == pytest.approx(sum(row.share for row in rows if row.object_id != -1))
    assert len(share_bars(rows, frames_looked_at(config)).axes) == 2
    for place in ("a", "b"):
        shutil.copytree(next((world / "test").iterdir()), world / "twice" / place / "one")
    with pytest.raises(DataError, match="drives: expected drives of different names, found two called 'one'"):
        share_drives(Sharing(checkpoint=world / "net.pt", data=world / "twice", out=world / "none"))
    with pytest.raises(SettingsError, match="shares: severity: expected 1 to 5, found 9"):
        share_drives(Sharing(checkpoint=world / "net.pt", data=world / "test", out=world, severity=9))


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_an_interrupted_run_resumes_with_the_same_bytes_for_any_workers(
    world: Path, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drives, "CHUNK", 1)
    out = world / f"resumed_{workers}"
    options = ["--corruption", "fog", "--checkpoint", str(world / "net.pt")]

    def files(workers: int) -> dict[str, bytes]:
        main(["shares", str(world / "test"), "--out", str(out), *options, "--workers", str(workers)])
        return {path.name: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    whole = files(1)
    cells = sorted((out / "cells").iterdir())
    assert len(cells) == 4  # two chunks, clean and in fog
    cells[0].unlink()
    cells[1].write_bytes(cells[1].read_bytes()[:-20])
    kept = {path: path.stat().st_mtime_ns for path in cells[2:]}
    assert files(workers) == whole  # its own files may be replaced
    assert {path: path.stat().st_mtime_ns for path in cells[2:]} == kept
    rows = share_drives(
        Sharing(checkpoint=world / "net.pt", data=world / "test", out=out, corruption=("fog",)),
        progress=lambda done, total: pytest.fail("computed again") if total else None,
    )
    places = [(row.frame, row.condition) for row in rows]
    assert places == sorted(places, key=lambda place: (place[0], place[1] != "clean"))
    with pytest.raises(SettingsError, match="shares: iou: expected more than 0, at most 1, found 0"):
        share_drives(Sharing(checkpoint=world / "net.pt", data=world / "test", out=world / "none", iou=0.0))
    assert not (world / "none").exists()
