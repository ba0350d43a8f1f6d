"""Page of a campaign: one file, the failures as pictures."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import msgspec
import pytest

from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.causes.cause import Cause
from dsrc.closed_loop.report.findings import Findings
from dsrc.closed_loop.report.gate import Gate
from dsrc.closed_loop.report.page import campaign_page, failures
from dsrc.closed_loop.report.picture import picture
from dsrc.closed_loop.report.report import write_report
from dsrc.closed_loop.types import Outcome
from sim.contact import Contact
from tests.dsrc.closed_loop.logged import Mover, ahead, episode
from tests.dsrc.closed_loop.results import PLAN, one

MOVERS = (Mover("ego", ahead(10.0)), Mover("conflict", lambda _: (9.0, 0.0), yaw=0.0))
CRASH = episode(MOVERS, 6, Outcome.CRASHED, contact=Contact(0.5, 1001, "conflict", 10.0, 10.0, 5.0, "front", True))
CRASHED = [
    msgspec.structs.replace(one("alone", seed, "crashed", delta_v_mps=float(seed)), key=str(seed)) for seed in range(3)
]
RESULT = CampaignResult(PLAN, (*CRASHED, one("alone", 3, "arrived")), (), (), 0, 0.0)


class Seen(HTMLParser):
    """Tags of a page, checked to be closed in order, and what it loads from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.pictures = 0
        self.elsewhere: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        self.pictures += tag == "img"
        links = [value or "" for name, value in attrs if name in ("src", "href")]
        self.elsewhere += [link for link in links if not link.startswith("data:image/png;base64,")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_a_page_is_one_file_with_a_picture_for_each_failure_that_has_a_log(tmp_path: Path) -> None:
    (tmp_path / "episodes").mkdir()
    CRASH.save(tmp_path / "episodes" / "2.npz")
    causes = {"2": Cause(kind="seen late", sentence="seen late by 200 ms: <the car>", late_s=0.2, seen_s=0.2)}
    told: list[tuple[int, int]] = []
    write_report(RESULT, tmp_path, Findings(causes=causes), lambda *steps: told.append(steps))
    assert told == [(1, 3), (2, 3), (3, 3)], "pictures take seconds each"
    text = (tmp_path / "report.html").read_text()
    seen = Seen()
    seen.feed(text)
    assert not seen.open and not seen.elsewhere
    assert seen.pictures == 2 + 1, "two plots and the crash with a log"
    assert "crashed: seen late by 200 ms: &lt;the car&gt;" in text
    assert "3 of 3." in text and text.count("<figcaption>") == 3
    assert re.findall(r"ima_building, alone, clean, seed (\d)</b>", text) == ["2", "1", "0"], "the hardest first"
    write_report(RESULT, tmp_path)  # a page of ours is replaced


def test_what_broke_against_the_baseline_comes_first() -> None:
    before = [msgspec.structs.replace(CRASHED[0], outcome="arrived"), *CRASHED[1:]]
    gate = Gate.of(RESULT, [], before)
    assert [each.seed for each in failures(RESULT.results, Findings(gate))] == [0, 2, 1]


def test_a_campaign_without_failures_has_no_pictures_of_them(tmp_path: Path) -> None:
    fine = replace(RESULT, results=(one("alone", 3, "arrived"),))
    assert "Failures" not in campaign_page(fine, Findings(), [], [], tmp_path)


def test_an_episode_without_a_step_has_no_picture() -> None:
    with pytest.raises(ValueError, match="at least one step"):
        picture(episode(MOVERS, 0))
