"""Examples: thirteen short scripts, each of which prints at once."""

import ast
from pathlib import Path

import pytest

from tests.commands import run_script
from tests.paths import ROOT

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SMALL = {
    "01_generate": (("--frames", "1"), "points; "),
    "02_own_detector": (("--duration-s", "1"), "02_own_detector:Clusters"),
    "03_own_driver": (("--seeds", "1"), "planning  seed 0  arrived"),
    "04_own_corruption": ((), "severity 5: "),
    "05_own_lidar": (("--rings", "8"), "8192 points of 8 rings"),
    "06_own_scenario": ((), "my_junction at "),
    "07_radio": (("--duration-s", "1"), "all lost"),
    "08_gymnasium": (("--steps", "2"), "2 steps, return "),
    "09_train": (("--epochs", "1", "--frames", "1"), "above the score threshold"),
    "10_review": (("--frames", "1"), "opens in any browser"),
    "11_detector_process": (("--test",), "boxes"),
    "12_highway_env_driver": (("--seeds", "1"), "red light: passes it"),
    "13_driver_process": (("--test",), "13_driver_process.py"),
}
"""Arguments that make an example fast, and a part of what it prints."""


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_says_how_to_use_it(script: Path) -> None:
    text = script.read_text()
    doc = ast.get_docstring(ast.parse(text)) or ""
    assert len(text.splitlines()) < 80
    assert f"Usage:\n    python examples/{script.name}" in doc
    assert f"`{script.name}`" in (ROOT / "examples/README.md").read_text()
    assert doc.splitlines()[0] in run_script(script, "--help").stdout


LONGER = ("07_radio", "09_train", "12_highway_env_driver", "13_driver_process")
"""Examples that take more than four seconds even so."""


@pytest.mark.parametrize(
    "script",
    [pytest.param(path, marks=pytest.mark.slow) if path.stem in LONGER else path for path in EXAMPLES],
    ids=lambda path: path.stem,
)
def test_an_example_runs_with_small_settings(script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    arguments, printed = SMALL[script.stem]
    done = run_script(script, *arguments)
    assert done.returncode == 0, done.stderr
    assert printed in done.stdout
