"""Critical values of an episode: a delay at which a seeing helper comes too late, and plans that no search can take."""

from typing import Any

import numpy as np
import pytest

from dsrc.closed_loop.campaign import search as searching
from dsrc.closed_loop.campaign.read import campaign_of
from dsrc.closed_loop.campaign.search import search, search_table, search_text
from dsrc.closed_loop.types import Outcome, Percept
from dsrc.faults.fault import faults_text
from dsrc.options.driving import DriveOptions
from sim.boxes import Boxes
from sim.errors import SettingsError
from sim.radio import get_channel
from sim.scenario import Scenario
from sim.traffic.base import Actors


class Late:
    """Perceives the truth, but the conflict actor only from some seconds after the start on."""

    cooperative = True

    def __init__(self, blind_s: float) -> None:
        self.blind_s = blind_s

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        self.ego_id, self.start_s = ego_id, None

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        self.start_s = now.time_s if self.start_s is None else self.start_s
        if now.time_s - self.start_s < self.blind_s:
            return Percept(now.time_s, Boxes.zeros(), np.zeros(0), np.zeros((0, 2)))
        rows = now.boxes.object_id != self.ego_id
        boxes = now.boxes[rows]
        return Percept(now.time_s, boxes, np.ones(len(boxes)), now.velocity[rows].copy())


@pytest.mark.slow
def test_the_delay_at_which_an_encounter_becomes_a_crash_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []

    def opened(uses: str, **settings: Any) -> Late:
        given.append(get_channel(settings["channel"]))
        return Late(10.0 * given[-1].delay_s)

    monkeypatch.setattr(searching, "open_perception", opened)
    options = DriveOptions(what="ima_building", perception=("team",), duration_s=15.0, detect_every_s=0.2)
    found = search(campaign_of(options), "delay_s")
    assert [one.medium for one in given] == ["perfect"] * len(given)
    assert found.outcomes[0.0] is Outcome.ARRIVED and found.outcomes[0.8] is Outcome.CRASHED
    (flip,) = found.value.flips
    assert flip.fails and flip.above - flip.below <= 0.2 + 1e-9
    assert len(search_table(found).rows) == len(found.outcomes)
    assert search_text(found).startswith("ima_building, team, seed 0, delay s: worse from ")


@pytest.mark.parametrize(
    ("fault", "quantity", "told"),
    [
        (
            "fog:3 from 2 s on ego + loss:0.3",
            "severity",
            {
                0.0: ("clean", "ideal,loss=0.3", ""),
                2.0: ("clean", "ideal,loss=0.3", "fog:2 from 2 s on ego"),
                5.0: ("clean", "ideal,loss=0.3", "fog:5 from 2 s on ego"),
            },
        ),
        ("fog:3", "severity", {0.0: ("clean", "ideal", ""), 4.0: ("fog 4", "ideal", "")}),
        (
            "loss:0.3 from 2 s to 5 s + fog:2",
            "loss",
            {
                0.0: ("clean", "ideal", "loss:0 from 2 s to 5 s + fog:2"),
                0.5: ("clean", "ideal", "loss:0.5 from 2 s to 5 s + fog:2"),
            },
        ),
        ("loss:0.3", "loss", {1.0: ("clean", "ideal,loss=1", "")}),
        ("fog:2", "delay_s", {0.4: ("fog 2", "ideal,delay_s=0.4", "")}),
        ("--corruption snow", "loss", {0.5: ("snow 3", "ideal,loss=0.5", "")}),
        ("--corruption snow", "severity", {0.0: ("clean", "ideal", ""), 2.0: ("snow 2", "ideal", "")}),
    ],
)
def test_a_quantity_is_that_of_the_fault_that_has_it(
    monkeypatch: pytest.MonkeyPatch, fault: str, quantity: str, told: dict[float, tuple[str, str, str]]
) -> None:
    """Beside it the other faults stay as they are; severity 0 is an episode without the corruption."""
    given: dict[float, tuple[str, str, str]] = {}

    def opened(_: str, **settings: Any) -> Late:
        given[-1.0] = (settings["corruption"].label, settings["channel"], faults_text(settings["fault"]))
        return Late(0.0)

    class Driven:
        def __init__(self, *_: object) -> None:
            pass

        def run(self, _: int) -> Outcome:
            return Outcome.ARRIVED

    monkeypatch.setattr(searching, "open_perception", opened)
    monkeypatch.setattr(searching, "ClosedLoop", Driven)
    given_as = {"corruption": ("snow",)} if fault == "--corruption snow" else {"fault": (fault,)}
    options = DriveOptions(what="ima_building", perception=("team",), detect_every_s=0.2, **given_as)  # type: ignore[arg-type]
    by_number: list[tuple[str, str, str]] = []
    found = search(campaign_of(options), quantity, lambda *_: by_number.append(given.pop(-1.0)))  # type: ignore[arg-type]
    driven = dict(zip(found.outcomes, by_number, strict=True))
    assert {round(value, 6): driven[value] for value in driven if round(value, 6) in told} == told


def test_delays_go_to_the_longest_whatever_the_interval() -> None:
    for interval_s, last in ((0.1, 1.0), (0.2, 1.0), (0.3, 0.9), (0.4, 0.8), (0.6, 0.6)):
        delays = searching._delays(interval_s)
        assert delays[0] == 0.0 and delays[-1] == pytest.approx(last)
        assert 0.0 < np.diff(delays).min() and np.diff(delays).max() <= 2.0 * interval_s + 1e-9


@pytest.mark.parametrize(
    ("change", "quantity", "told"),
    [
        ({"perception": ("team",), "detect_every_s": 1.5}, "delay_s", "detect_every_s: expected at most 1 s"),
        ({"perception": ("truth",)}, "loss", "detector with helpers"),
        ({"perception": ("ego",)}, "delay_s", "detector with helpers"),
        ({"perception": ("team",)}, "severity", "corruption"),
        ({"perception": ("team",), "seed": (0, 1)}, "loss", "seed"),
        ({"perception": ("team",), "corruption": ("fog", "snow")}, "severity", "corruption"),
        ({"perception": ("team", "ego"), "corruption": ("fog",)}, "severity", "perception"),
        ({"perception": ("team",), "fault": ("loss:0.3",)}, "severity", "corruption: expected one value"),
        ({"perception": ("team",), "fault": ("fog:3 + snow:2",)}, "severity", "one fault with a severity .* fog snow"),
        ({"perception": ("team",), "fault": ("fog:3", "fog:4")}, "severity", "fault"),
        (
            {"perception": ("team",), "corruption": ("fog",), "fault": ("loss:0.3",)},
            "severity",
            "--fault 'fog:3 [+] loss:0.3'",
        ),
    ],
)
def test_a_plan_of_more_than_one_episode_or_without_the_quantity_is_refused(
    change: dict[str, Any], quantity: str, told: str
) -> None:
    with pytest.raises(SettingsError, match=told):
        search(campaign_of(DriveOptions(what="ima_building", **change)), quantity)
