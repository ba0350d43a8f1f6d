"""The examples run."""

from pathlib import Path

import pytest

from tests.commands import run_script
from tests.paths import ROOT


def run(script: Path, *args: str) -> str:
    """Run an example and return what it printed."""
    result = run_script(script, *args, env={"DSRC_LIDAR_ENGINE": "public"})
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_a_driver_of_one_s_own_drives_beside_the_shipped_one() -> None:
    cautious, planning = run(ROOT / "examples/own_driver.py", "--seeds", "1").splitlines()
    assert cautious.startswith("cautious  seed 0  ")
    assert planning.startswith("planning  seed 0  arrived")


@pytest.mark.slow
def test_a_detector_of_one_s_own_sees_what_nothing_hides() -> None:
    own, truth = run(ROOT / "examples/own_detector.py").splitlines()
    assert own.split()[:2] == ["own_detector:Clusters", "arrived,"]
    assert truth.split()[:2] == ["truth", "arrived,"]
