import math

import pytest

from dsrc.evaluation.metrics.robustness import corruption_errors, mce, mean_ap

KINDS = ("beam_missing", "motion_blur", "fog", "snow", "crosstalk", "cross_sensor")
# Table 1 of the paper, OPV2V: clean and the six corruptions, AP at IoU 0.5 and 0.7 in percent.
PAPER = {
    "dsrc 0.5": (92.58, (85.82, 86.20, 83.54, 74.14, 90.76, 85.77), 8.87),
    "dsrc 0.7": (88.45, (79.59, 69.41, 69.84, 67.25, 84.57, 77.64), 15.53),
    "v2vnet 0.5": (92.29, (83.30, 83.87, 68.22, 73.90, 90.33, 81.40), 13.13),
}


@pytest.mark.parametrize("row", PAPER)
def test_mce_of_the_papers_rows(row: str) -> None:
    clean, corrupted, expected = PAPER[row]
    assert 100 * mce(clean, dict(zip(KINDS, corrupted, strict=True))) == pytest.approx(expected, abs=0.01)


def test_mean_ap_includes_the_clean_frames() -> None:
    clean, corrupted, _ = PAPER["dsrc 0.5"]
    assert mean_ap(clean, dict(zip(KINDS, corrupted, strict=True))) == pytest.approx(85.54, abs=0.01)


def test_a_detector_that_finds_nothing_has_no_corruption_error() -> None:
    assert math.isnan(mce(0.0, {"fog": 0.0}))
    assert math.isnan(mce(math.nan, {"fog": 0.5}))
    assert math.isnan(mce(0.8, {}))
    assert mean_ap(0.0, {"fog": 0.0}) == 0.0


def test_a_corruption_that_helps_has_a_negative_error() -> None:
    assert corruption_errors(0.5, {"fog": 0.6})["fog"] == pytest.approx(-0.2)
