"""Joined detectors: the detections of each, one list."""

from pathlib import Path

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from dsrc.__main__ import main
from dsrc.data.sample import make_sample
from dsrc.models.detector import Detector
from dsrc.models.joined import JoinedDetectors, tiles_of
from dsrc.models.storage.checkpoint import load_joined, load_student, save_detector
from dsrc.ops.grid import GridSpec
from dsrc.training.recipes import debug
from sim.boxes import CLASSES
from sim.errors import CheckpointError, SettingsError
from tests.dsrc.data.toy import toy_frame

WHOLE = GridSpec(range_m=(-25.6, -12.8, -3.0, 25.6, 12.8, 2.6))
PLAIN = replace(debug().model, sdd=False, pcp=False, rec=False, grid=WHOLE, score_prior=None, score_threshold=0.4)


def detectors() -> tuple[Detector, Detector]:
    torch.manual_seed(3)
    near = GridSpec(range_m=(-12.8, -6.4, -3.0, 12.8, 6.4, 1.0), cell_m=0.2)
    return Detector(PLAIN).eval(), Detector(replace(PLAIN, users="vulnerable", grid=near)).eval()


def test_joined_detectors_find_what_each_finds_best_first() -> None:
    first, second = detectors()
    joined = JoinedDetectors((first, second))
    sample = make_sample(toy_frame(0), None, joined.settings.request)
    parts, found = (first.detect(sample), second.detect(sample)), joined.detect(sample)
    assert min(len(part) for part in parts) > 0 and len(found) == sum(len(part) for part in parts)
    assert (np.diff(found.score) <= 0).all()
    names = {CLASSES[label] for label in found.boxes.label}
    assert "car" in names and names & {"pedestrian", "bicycle"} and names <= set(joined.classes)


def test_what_agents_detect_alone_joins_to_what_late_fusion_detects() -> None:
    torch.manual_seed(3)
    late = replace(PLAIN, fusion="late")
    joined = JoinedDetectors((Detector(late).eval(), Detector(replace(late, users="vulnerable")).eval()))
    sample = make_sample(toy_frame(0), None, joined.settings.request)
    for detector in (joined, joined.detectors[0]):
        parts, found = detector.detect_each(sample), detector.detect(sample)
        assert len(parts) == len(sample.agent_ids) > 1 and min(len(part) for part in parts) > 0
        again = detector.joined(parts)
        assert again.boxes.array.tobytes() == found.boxes.array.tobytes()
        assert again.score.tobytes() == found.score.tobytes()
    with pytest.raises(ValueError, match="expected a detector with late fusion, found one with"):
        detectors()[0].detect_each(sample)


def test_lost_tiles_are_the_same_places_on_another_grid() -> None:
    half = GridSpec(range_m=(-12.8, -12.8, -3.0, 12.8, 12.8, 1.0))
    fine = GridSpec(range_m=(0.0, 0.0, -3.0, 25.6, 12.8, 1.0), cell_m=0.2)
    lost = np.random.default_rng(0).random((8, 16)) < 0.5  # 64 x 128 cells
    np.testing.assert_array_equal(tiles_of(lost, WHOLE, half), lost[:, 4:12])
    np.testing.assert_array_equal(tiles_of(lost, WHOLE, fine), np.repeat(np.repeat(lost[4:, 8:], 2, 0), 2, 1))
    assert tiles_of(lost, WHOLE, WHOLE) is lost


def test_two_detectors_of_the_same_users_or_a_larger_grid_are_refused() -> None:
    first, second = detectors()
    with pytest.raises(SettingsError, match="users: expected different road users, found vehicles and vehicles"):
        JoinedDetectors((first, first))
    with pytest.raises(SettingsError, match="grid: expected a range within"):
        JoinedDetectors((second, first))


def test_a_file_of_joined_detectors_finds_what_they_find(tmp_path: Path) -> None:
    files = [tmp_path / "vehicles.pt", tmp_path / "vulnerable.pt"]
    for file, detector in zip(files, detectors(), strict=True):
        save_detector(file, detector, half=False)
    joined, out = JoinedDetectors(detectors()), tmp_path / "both.pt"
    main(["model", "join", *map(str, files), "--out", str(out)])
    read = load_joined(out, engine="plain")
    sample = make_sample(toy_frame(0), None, joined.settings.request)
    found, expected = read.detect(sample), joined.detect(sample)
    np.testing.assert_array_equal(found.boxes.array, expected.boxes.array)
    assert load_joined(out, fusion="late").settings.fusion == "late"
    assert isinstance(load_joined(files[0]), Detector)
    with pytest.raises(CheckpointError, match="format: expected dsrc-detector-1, found dsrc-detectors-1; only"):
        load_student(out)
