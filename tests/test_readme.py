"""README and docs: their Python runs, their commands parse."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dsrc.cli.main import COMMANDS, command_class
from dsrc.cli.options import parse
from dsrc.closed_loop.metrics.episode import EpisodeMetrics
from dsrc.data.write import generate
from sensors.deskew import deskew
from sim.boxes import Boxes
from tests.paths import ROOT


def blocks_of(page: str) -> list[str]:
    """Return the blocks of Python on a page."""
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


(BEGIN,), (SIMULATED, DRIVEN, SCANNED) = blocks_of("README.md"), blocks_of("docs/python.md")


def test_the_readme_s_python_prints_without_a_demo_before(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    exec(BEGIN, {})
    first, clear, snow, sight, truth = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"5 agents, \d+ LiDAR points, \d+ true boxes", first)
    found = [int(re.findall(r": (\d+) detections", line)[0]) for line in (clear, snow)]
    assert found[0] > found[1] > 0
    assert (sight, truth) == ("left turn by sight: crashed", "left turn by truth: arrived")


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 900


def test_the_example_of_a_drive_detects_in_fog(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dsrc").symlink_to(ROOT / "dsrc")
    generate("four_way", tmp_path / "demo" / "test", frames=1, seed=900, visibility=False)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(SIMULATED, names)
    assert len({agent.sweep.time_s for agent in names["frame"].agents}) == 1
    assert len(names["frame"].truth) > 0
    assert isinstance(names["detections"].boxes, Boxes)
    assert len(names["first"].agents) > 1
    assert np.isfinite(names["reward"]) and names["env"].observation_space.contains(names["observation"])
    raw, middle = names["raw"].agents[0].sweep, names["frame"].agents[0].sweep
    assert (raw.motion, middle.motion) == ("raw", "middle")
    np.testing.assert_allclose(deskew(raw, "middle").points, middle.points, atol=1e-3)


def test_the_example_of_the_closed_loop_arrives_and_looks_again() -> None:
    names: dict = {}
    exec(DRIVEN, names)
    assert names["outcome"].value == "arrived"
    assert names["metrics"].driving_score_2_1 == 1.0
    assert names["again"].settings.perception == "sight"
    assert len(names["again"]) == len(names["log"])


def test_the_example_of_a_lidar_of_one_s_own_measures_the_hall() -> None:
    names: dict = {}
    exec(SCANNED, names)
    sweep, lidar = names["sweep"], names["lidar"]
    assert lidar.rings == 32
    assert len(np.unique(sweep.ring.astype(int) * lidar.columns + sweep.column)) == lidar.rings * lidar.columns
    half = 0.5 * np.ptp(names["hall"].vertices, axis=0)
    # The nearest wall is as far from every point as the sensor's noise lets it be, though the sensor drove on.
    off = np.abs(half - np.abs(sweep.world_points)).min(axis=1)
    assert np.median(off) < lidar.range_noise_m
    assert off.max() < 6.0 * lidar.range_noise_m
    bent = names["raw"]
    assert bent.motion == "raw"
    # 1 m in a sweep of 0.1 s.
    expected = np.column_stack([10.0 * sweep.time_offset, np.zeros((len(sweep), 2))])
    np.testing.assert_allclose(sweep.points - bent.points, expected, atol=1e-4)


def test_every_metric_of_an_episode_has_a_row() -> None:
    table = (ROOT / "docs/campaigns.md").read_text(encoding="utf-8").split("\n## Metrics\n")[1].split("\n## ")[0]
    named = " ".join(re.findall(r"^\| (`[^|]*) \|", table, re.MULTILINE))
    listed = re.findall(r"`(\w+)`", named)
    assert sorted(listed) == sorted(EpisodeMetrics.__struct_fields__)


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted(ROOT.glob("d*/*/README.md"))]
PAGES += [ROOT / "studies/shipped/README.md"]


def commands_of(page: Path) -> Iterator[list[str]]:
    """Yield the words of every whole command on a page: those in blocks of code and in tables."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    for found in re.findall(r"(?:^|do |^\| `)dsrc ([^\n`;]*)", "\n".join(blocks), re.MULTILINE):
        yield shlex.split(re.sub(r"\$\w+", "1", found), comments=True)
    yield from map(shlex.split, re.findall(r"^\|(?: [^|`]+ \|)? `dsrc ([^`]*)`", text, re.MULTILINE))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_command_of_a_page_parses(page: Path) -> None:
    for name, *words in commands_of(page):
        found = COMMANDS[name]
        if not isinstance(found, str):
            found = found[words.pop(0)]
        parse(command_class(found), "dsrc", words)
    for name, part in re.findall(r"`dsrc (?!help\b)([a-z]+)(?: ([a-z]+))?", page.read_text(encoding="utf-8")):
        assert name in COMMANDS, name
        assert isinstance(COMMANDS[name], str) or part in COMMANDS[name], (name, part)
