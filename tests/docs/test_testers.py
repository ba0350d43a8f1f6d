"""What a tester comes with: one command of the docs each, run as it stands there but for less of it."""

import re
import shlex
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from dsrc.closed_loop.report.baseline import read_baseline
from tests.commands import dsrc
from tests.paths import ROOT

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs are those of the environment, as for somebody who has activated it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=":")


def page_of(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def run(page: str, begin: str, *less: str) -> str:
    """Run the only command of a page that begins so, with more options at its end, and return what it prints."""
    text = page_of(page).replace("\\\n", " ")
    (found,) = re.findall(rf"^(dsrc {re.escape(begin)}[^\n]*)$", text, re.MULTILINE)
    done = dsrc(*shlex.split(found, comments=True)[1:], *less)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_faults_are_composed(tmp_path: Path) -> None:
    run("faults.md", "drive lta_truck", "--seed", "0", "--duration-s", "4")
    driven = {(one.fault, one.channel): one for one in read_baseline(tmp_path / "runs" / "faults")}
    clean, composed = ("", "ideal"), ("fog:4 from 1 s to 4 s on helpers + loss:0.5 from 2 s", "ideal")
    assert driven.keys() == {clean, composed, ("", "ideal,burst_loss=0.3,burst_s=1")}
    received = {key: one.metrics["received_mb"] or 0.0 for key, one in driven.items()}
    assert 0.0 < received[composed] < 0.9 * received[clean]


def test_an_attack_meets_a_defence(tmp_path: Path) -> None:
    table = run("attacks.md", "drive ima_building", "--seed", "0", "--duration-s", "4", "--out", "attacked")
    assert "ghost:1 on -1" in table and "defended by" in table
    lies = {one.defence: one.metrics for one in read_baseline(tmp_path / "attacked") if one.fault}
    assert lies.keys() == {"", "free-space,trust"} and all(lie["false_told"] for lie in lies.values())
    assert lies[""]["false_refused"] == 0.0 and lies["free-space,trust"]["false_refused"]


@pytest.mark.parametrize("scenario", ["ima_queue", "eebl_chain"])
def test_a_driver_of_one_s_own_drives(scenario: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT / "examples")
    table = run("own_driver.md", f"drive {scenario}", "--perception", "truth", "--seed", "0", "--duration-s", "1")
    assert scenario in table


def test_an_encounter_is_mined_and_driven(tmp_path: Path) -> None:
    run("scenarios.md", "scenario mine", "--count", "1")
    (mined,) = (path.parent.name for path in (tmp_path / "mined").glob("*/scenario.toml"))
    assert mined.startswith("helsinki_")
    run("scenarios.md", "drive mined", "--perception", "truth", "--out", "driven")
    (driven,) = read_baseline(tmp_path / "driven")
    assert Path(driven.scenario).name == mined and driven.outcome == "arrived"


def test_a_search_is_made(tmp_path: Path) -> None:
    run("search.md", "search lta_truck", "--perception", "truth", "--budget", "2", "--optimizer", "random")
    assert len((tmp_path / "runs" / "search" / "tried.csv").read_text().splitlines()) == 2 + 2


def test_a_gate_compares_with_what_was_driven_before(tmp_path: Path) -> None:
    (plan,) = re.findall(r"`plan.toml`.*?```toml\n(.*?)```", page_of("campaigns.md"), re.DOTALL)
    (tmp_path / "plan.toml").write_text(plan)
    assert dsrc("drive", "plan.toml", "--out", "runs/old").returncode == 0
    assert "holds" in run("campaigns.md", "drive plan.toml")
    cases = ElementTree.parse(tmp_path / "drive.xml").findall(".//testcase")
    assert [case.get("name") for case in cases] == ["team: crashed<=5%, team", "broken<=0, team", "seed 0"]
