"""The check of drivers says what one does wrong, in its contract and on the road."""

import dataclasses
import math

import pytest

from dsrc.closed_loop.driving.check import check_driver
from dsrc.closed_loop.driving.idm import IdmSettings, following_acceleration, free_acceleration
from dsrc.closed_loop.types import Decision, EgoState, LaneMap, Tracks
from sim.errors import SettingsError


class Free:
    """Drives at the limit whatever comes."""

    def reset(self, lanes: LaneMap | None) -> None:
        pass

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        return Decision(2.0 * (ego.limits.speed_mps - ego.speed_mps), "free")


class Following(Free):
    """Follows whoever is on its lane, stops at red, and looks to neither side."""

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        settings, speed, wanted = IdmSettings(), ego.speed_mps, ego.limits.speed_mps
        offset = tracks.boxes.center[:, :2] - ego.box.center[0, :2]
        gaps = [(x - 4.5, tracks.velocity[k, 0]) for k, (x, y) in enumerate(offset) if x > 0.0 and abs(y) < 1.5]
        gaps += [(light.distance_m, 0.0) for light in ego.lights if light.state == "red"]
        found = [following_acceleration(speed, wanted, gap, lead, settings) for gap, lead in gaps]
        return Decision(min([free_acceleration(speed, wanted, settings), *found]))


class Standing(Free):
    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        return Decision(-5.0)


class Racing(Free):
    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        return Decision(2.0)


class Unsure(Free):
    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        return Decision(math.nan)


class Plain(Free):
    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        return 0.0  # type: ignore[return-value]


class Mapped(Free):
    def reset(self, lanes: LaneMap | None) -> None:
        lanes.ahead  # type: ignore[union-attr]  # noqa: B018


class Remembering(Free):
    calls = 0

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        self.calls += 1
        return Decision(1.0 / self.calls)


class Careless(Free):
    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        tracks.velocity[:] = 0.0
        return super().decide(ego, tracks)


def test_a_driver_that_looks_at_nothing_is_told_what_it_hits() -> None:
    found = check_driver(Free)
    assert [line.partition(":")[0] for line in found] == [
        *("standing car", "slow car", "braking car", "crossing car", "red light")
    ]
    assert "standing car: touches it at 13.9 m/s" in found and "red light: passes it" in found


def test_a_driver_that_follows_hits_who_comes_from_the_side_alone() -> None:
    (found,) = check_driver(Following())
    assert found.startswith("crossing car: touches it at ")


def test_a_driver_that_stands_and_one_that_races_are_told_so() -> None:
    assert "empty road: drives 0 m in 15 s, expected 100 m or more" in check_driver(Standing)
    assert "empty road: drives 29.8 m/s at a limit of 13.9 m/s" in check_driver(Racing)


def test_the_shipped_driver_does_nothing_wrong() -> None:
    assert check_driver("planning") == ()


@pytest.mark.parametrize(
    ("driver", "words"),
    [
        (Unsure, "Unsure: empty road: ValueError: decide: expected a finite acceleration, found nan"),
        (Plain, "Plain: empty road: TypeError: decide: expected a Decision, found float"),
        (Mapped, "Mapped: without lanes: AttributeError: "),
        (Remembering, "Remembering: reset: expected the same decisions in the same drive after a reset, found others"),
        (object, "object: reset: expected a method, found none\nobject: decide: expected a method, found none"),
        ("plannin", "did you mean 'planning'?"),
        (dataclasses.make_dataclass("Unmade", ["model"]), "Unmade: class: does not work: TypeError"),
    ],
)
def test_a_broken_rule_of_the_contract_is_a_line(driver: object, words: str) -> None:
    with pytest.raises(SettingsError) as raised:
        check_driver(driver)
    assert words in str(raised.value)
