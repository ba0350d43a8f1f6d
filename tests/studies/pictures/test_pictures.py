"""Pictures and tables of the pages."""

from pathlib import Path

import pytest
from PIL import Image

from sensors.corruptions import CORRUPTIONS
from sensors.presets import LIDARS
from tests.commands import study
from tests.dsrc.evaluation.small import write_detector, write_drives
from tests.paths import ROOT

SMALL = {
    "pictures.channel": ("--frames", "28"),
    "pictures.corruptions": ("--only", "fog", "pose_error", "--scenario", "four_way"),
    "pictures.lidar_presets": ("--only", "debug-16", "--scenario", "four_way"),
    "pictures.lidar_effects": (),
    "pictures.scenarios": ("--only", "ped_bus_stop"),
    "pictures.places": ("--only", "four_way"),
    "pictures.sweeps": ("--only", "ped_bus_stop"),
    "closed_loop.same_crash": ("--perceptions", "truth", "truth"),
    "pictures.lidar_realism": ("--scenarios", "four_way", "--sensors", "debug-16", "--frames", "1"),
}


LONGER = tuple(
    f"pictures.{name}" for name in ("channel", "corruptions", "lidar_realism", "places", "scenarios", "sweeps")
)
"""Studies that take more than four seconds even so."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in LONGER else name for name in SMALL]
)
def test_a_study_draws_in_seconds_on_a_small_setting(name: str, tmp_path: Path) -> None:
    printed = study(name, "--out", str(tmp_path), *SMALL[name])
    pictures = list(tmp_path.glob("*.png"))
    assert pictures
    for picture in pictures:
        assert str(picture) in printed
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert picture.stat().st_size < 300_000


def test_the_left_turn_moves_and_is_small() -> None:
    path = ROOT / "docs/pictures/closed_loop/left_turn.gif"
    assert path.stat().st_size < 2_000_000
    with Image.open(path) as picture:
        assert getattr(picture, "n_frames", 1) > 30


@pytest.mark.parametrize("name", LIDARS)
def test_every_preset_is_pictured(name: str) -> None:
    picture = f"pictures/lidar/{name}.png"
    assert (ROOT / "docs" / picture).is_file(), (
        f"python -m studies.pictures.lidar_presets --out docs/pictures/lidar --only {name}"
    )
    assert f"]({picture})" in (ROOT / "docs" / "lidar.md").read_text()


@pytest.mark.parametrize("kind", [*CORRUPTIONS, "all"])
def test_every_corruption_is_pictured(kind: str) -> None:
    picture = f"pictures/corruptions/{kind}.png"
    assert (ROOT / "docs" / picture).is_file(), (
        f"python -m studies.pictures.corruptions --out docs/pictures/corruptions --only {kind}"
    )
    assert f"]({picture})" in (ROOT / "docs" / "corruptions.md").read_text()


@pytest.mark.slow
def test_the_table_of_weather_takes_the_place_of_the_one_before(tmp_path: Path) -> None:
    document = tmp_path / "weather.md"
    document.write_text("before\n<!-- begin weather_shares -->\nold\n<!-- end weather_shares -->\nafter\n")
    script = "pictures.weather_shares"
    study(script, "--scenario", "four_way", "--lidar", "debug-16", "--docs", str(document))
    before, *table, after = (line for line in document.read_text().splitlines() if not line.startswith("<!--"))
    assert (before, after) == ("before", "after")
    cells = {row[1]: row[2:] for row in ([cell.strip() for cell in line.split("|")[:-1]] for line in table)}
    scattered = [float(cell.split(" / ")[0]) for cell in cells["**snow**"]]
    assert len(scattered) == 5
    assert scattered == sorted(scattered)
    assert scattered[-1] > 1.5 * scattered[0] > 0.0


@pytest.mark.slow
def test_snow_is_taken_apart_for_any_detector_and_drives(tmp_path: Path) -> None:
    drives = write_drives(tmp_path / "data")
    detector = write_detector(tmp_path / "detector.pt", "attfuse")
    arguments = ("--data", str(drives), "--checkpoint", str(detector), "--frames", "1")
    experiments, _, pillars = study("pictures.snow_pillars", *arguments).strip().partition("\n| within 15 m")
    assert [line.split(" | ")[0] for line in experiments.splitlines()][2:4] == ["| clear air", "| **snow**"]
    assert experiments.splitlines()[-1].startswith("| norms' statistics measured again in snow")
    assert pillars.splitlines()[-1].startswith("| median confidence at true objects")
    clear = next(line for line in experiments.splitlines() if line.startswith("| clear air")).split(" | ")
    assert clear[1] == clear[2] and clear[3] == clear[4].rstrip(" |")  # of no severity
