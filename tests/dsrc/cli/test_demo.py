"""The demo walks from nothing to a table, plots, a page and an episode."""

from pathlib import Path

import pytest

from dsrc.cli.demo import ALONE, TOGETHER, lesson, run_demo
from sensors.corruptions import PAPER_SIX


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_the_demo_leaves_everything_it_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_demo(tmp_path, quick=True)
    said = capsys.readouterr().out
    results = (tmp_path / "results" / "results.csv").read_text()
    assert all(kind in results for kind in ("clean", *PAPER_SIX))
    for name in ("review.html", "drive/results.csv", "results/ap_per_corruption.png", "results/mce_map.png"):
        assert (tmp_path / name).stat().st_size > 0
        assert Path(name).name in said.replace("\n", "")


def test_the_lesson_is_what_happened() -> None:
    assert "waits" in lesson({ALONE: "crashed", TOGETHER: "arrived"})
    assert "not decide" in lesson({ALONE: "arrived", TOGETHER: "arrived"})
    assert "without --quick" in lesson({ALONE: "desynchronised", TOGETHER: "desynchronised"})
    assert lesson({ALONE: "arrived", TOGETHER: "crashed"}) == "Alone: arrived; with helpers: crashed."
