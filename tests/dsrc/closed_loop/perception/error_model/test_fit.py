"""Fit of an error model: known errors are found again, empty corners are pooled and say so, the file is checked."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from dsrc.closed_loop.perception.error_model.fit import EXAMPLES, LEAST, classes_found, fit_errors
from dsrc.closed_loop.perception.error_model.model import Cell, Chance, ErrorModel, Errors, read_model, write_model
from dsrc.closed_loop.perception.error_model.percepts import Observed
from dsrc.closed_loop.perception.error_model.sight import quarters_of
from sensors.corruptions import Condition
from sim.errors import DataError, SettingsError
from tests.dsrc.closed_loop.perception.error_model import percepts
from tests.dsrc.closed_loop.perception.error_model.percepts import INTERVAL_S, sequence


@pytest.fixture(scope="module")
def errors() -> Errors:
    return fit_errors([sequence(seed) for seed in range(100, 140)], INTERVAL_S)


def cell_of(errors: Errors, kind: str, sight: str, range_m: tuple[float, float], across: bool = False) -> Cell:
    wanted = kind, sight, across, range_m
    return next(one for one in errors.cells if (one.kind, one.sight, one.across, one.range_m) == wanted)


def model_of(errors: Errors) -> ErrorModel:
    return ErrorModel(
        perception="by hand",
        cooperative=False,
        interval_s=INTERVAL_S,
        classes=classes_found([errors]),
        conditions=(errors,),
    )


def test_rates_of_misses_are_found_again_within_their_intervals(errors: Errors) -> None:
    cell = cell_of(errors, "car", "clear", (15.0, 30.0))
    # Three intervals at 95 %: of one sample of 19,000 cars in percepts.
    for chance, true in (
        (cell.found.first, percepts.FOUND),
        (cell.found.after_yes, percepts.AFTER_FOUND),
        (cell.found.not_yet, percepts.AFTER_MISSED),
        (cell.found.after_no, percepts.AFTER_MISSED),
    ):
        assert chance.of == "cell"
        assert chance.low <= true <= chance.high
        assert chance.high - chance.low < 0.2


def test_errors_of_boxes_are_those_of_the_objects_frame(errors: Errors) -> None:
    cell = cell_of(errors, "car", "clear", (15.0, 30.0))
    # Correlated draws: the effective number is (1 - c) / (1 + c) of them.
    effective = cell.errors.boxes * (1 - percepts.CORRELATION) / (1 + percepts.CORRELATION)
    assert np.abs(np.array(cell.errors.bias) - percepts.BIAS).max() < 4.0 * percepts.SD.max() / np.sqrt(effective)
    assert np.allclose(cell.errors.sd, percepts.SD, rtol=0.1)
    assert np.allclose(errors.correlation[:7], percepts.CORRELATION, atol=0.05)
    assert errors.correlation[7] < 0.05  # scores were drawn anew in each percept
    assert np.allclose(cell.errors.score, np.linspace(*percepts.SCORES, 11), atol=0.02)


def test_boxes_across_their_objects_are_told_by_where_the_objects_head(errors: Errors) -> None:
    def turned(seed: int) -> list[Observed]:
        """Percepts of an ego that heads elsewhere, and finds a quarter turn too much of each car."""
        return [
            replace(
                one,
                ego=one.ego + np.array([0.0, 0.0, 0.5 * np.pi]),
                found=replace(one.found, yaw=one.found.yaw + 0.5 * np.pi),
            )
            for one in sequence(seed)
        ]

    mixed = fit_errors([*map(sequence, range(5)), *map(turned, range(5, 10))], INTERVAL_S)
    along, across = mixed.crossed
    assert (along.first.p, along.after_no.p, across.first.p, across.after_yes.p) == (0.0, 0.0, 1.0, 1.0)
    assert min(along.first.trials, across.first.trials) >= LEAST
    assert all(chain.first.p == 0.0 for chain in mixed.flipped)
    cell = cell_of(mixed, "car", "clear", (15.0, 30.0))
    assert abs(cell.errors.bias[6] - percepts.BIAS[6]) < 0.03
    assert cell.errors.sd[6] == pytest.approx(percepts.SD[6], rel=0.1)  # a quarter turn is no noise


def test_boxes_that_point_backwards_are_told_by_where_the_objects_head() -> None:
    def lines(seed: int, turn: float) -> list[Observed]:
        """Percepts of an ego at an angle to the cars, and of a network that knows no more than the line of a car."""
        seen = []
        for one in sequence(seed):
            ego = one.ego + np.array([0.0, 0.0, turn])
            half = np.rint((one.found.yaw - ego[2]) / np.pi) * np.pi
            seen.append(replace(one, ego=ego, found=replace(one.found, yaw=one.found.yaw - half)))
        return seen

    ahead = [lines(seed, 0.0) for seed in range(5)]
    heading = float(np.median(ahead[0][0].truth.yaw - ahead[0][0].ego[2]))
    against = [lines(seed, np.pi) for seed in range(5, 10)]
    fitted = fit_errors([*ahead, *against], INTERVAL_S).flipped
    same, opposed = ((quarters_of(np.array([heading + turn]))[0]) for turn in (0.0, np.pi))
    assert {fitted[same].first.p, fitted[opposed].first.p} == {0.0, 1.0}
    assert fitted[opposed].after_yes.trials >= LEAST


def test_cars_across_the_ego_s_heading_have_rates_of_their_own() -> None:
    blind = [
        replace(one, ego=one.ego + np.array([0.0, 0.0, 0.5 * np.pi]), found=one.found[:0], score=one.score[:0])
        for one in sequence(5)
    ]
    mixed = fit_errors([sequence(0), blind], INTERVAL_S)
    along, across = (cell_of(mixed, "car", "clear", (15.0, 30.0), across).found for across in (False, True))
    assert abs(along.after_yes.p - percepts.AFTER_FOUND) < 0.1
    assert (across.not_yet.p, across.not_yet.of) == (0.0, "cell")


def test_second_boxes_are_those_of_their_objects_and_no_ghosts() -> None:
    """Every car that is found in one half of the percepts is found once more, 1.5 m ahead of it and a little larger."""

    def twice(seed: int) -> list[Observed]:
        return [percepts.with_second(one) if row % 2 else one for row, one in enumerate(sequence(seed, ghosts=False))]

    errors = fit_errors(map(twice, range(4)), INTERVAL_S)
    along, across = errors.doubles.there
    assert (along.after_yes.p, along.after_no.p, across.first.trials) == (0.0, 1.0, 0)
    assert errors.ghosts.born == 0.0
    offset = np.array(errors.doubles.examples)
    assert len(offset) == EXAMPLES
    assert offset[:, 0].mean() == pytest.approx(percepts.BIAS[0] + 1.5, abs=0.1)
    assert offset[:, 3].mean() == pytest.approx(percepts.BIAS[3] + np.log(1.1), abs=0.02)
    assert (offset[:, 7] == 0.2).all()


def test_ghosts_are_born_and_live_as_they_did(errors: Errors) -> None:
    assert errors.ghosts.born == pytest.approx(percepts.BORN, abs=0.05)
    assert errors.ghosts.lives.p == pytest.approx(percepts.LIVES, abs=0.03)
    places = np.array(errors.ghosts.examples)
    assert (places[:, 0] < 0).all()  # behind the ego, in its frame, wherever it was


def test_an_empty_corner_takes_the_pooled_rate_and_says_so(errors: Errors) -> None:
    near, far = (cell_of(errors, "car", "clear", ends) for ends in ((15.0, 30.0), (50.0, 80.0)))
    assert far.found.after_yes.of == "kind, sight and heading"
    assert far.found.after_yes.p > percepts.AFTER_FOUND - 0.03
    assert far.errors.of == "kind, sight and heading"
    across = cell_of(errors, "car", "clear", (15.0, 30.0), across=True)
    assert across.found.after_yes.of == "kind and sight"
    partly = cell_of(errors, "car", "partly", (0.0, 15.0))
    assert (partly.found.after_no.of, partly.found.after_no.trials >= LEAST) == ("all", True)
    hidden = cell_of(errors, "car", "hidden", (0.0, 15.0))  # never observed: not found, whatever is in sight
    assert (hidden.found.after_no.p, hidden.found.after_no.high, hidden.found.after_no.trials) == (0.0, 1.0, 0)
    person = cell_of(errors, "pedestrian", "clear", (15.0, 30.0))
    assert person.found.first.of == "sight"
    assert near.found.first.of == "cell"


def test_what_is_hidden_keeps_its_own_rate() -> None:
    hidden = [replace(one, found=one.found[:0], score=one.score[:0]) for one in sequence(99, sight="hidden")]
    errors = fit_errors([*map(sequence, range(4)), hidden], INTERVAL_S)
    after_found = cell_of(errors, "car", "hidden", (15.0, 30.0)).found.after_yes  # it never happened
    assert (after_found.p, after_found.of) == (0.0, "kind and sight, whatever came before")


def test_classes_are_those_that_were_found(errors: Errors) -> None:
    assert classes_found([errors]) == ("car", "van")
    assert classes_found([fit_errors([], INTERVAL_S)]) == ()


def test_a_gap_in_time_breaks_the_chain() -> None:
    whole = sequence(0, percepts=40)
    parted = fit_errors([whole[:10] + whole[15:25] + whole[30:]], INTERVAL_S)
    first = cell_of(parted, "car", "clear", (15.0, 30.0)).found.first
    assert (first.trials, first.of) == (3 * 8, "cell")
    joined = fit_errors([whole[:30]], INTERVAL_S)
    assert cell_of(joined, "car", "clear", (15.0, 30.0)).found.first.of != "cell"


def test_a_chain_over_another_interval_keeps_its_rate() -> None:
    def chance(p: float) -> Chance:
        return Chance(p=p, low=0.0, high=1.0, trials=1)

    chain = fit_errors([sequence(0)], INTERVAL_S).cells[0].found
    chain = msgspec.structs.replace(
        chain, first=chance(0.5), after_yes=chance(0.9), after_no=chance(0.3), not_yet=chance(0.2)
    )
    rate = 0.3 / (0.3 + 0.1)
    twice = (0.9 * 0.9 + 0.1 * 0.3, 0.3 * 0.9 + 0.7 * 0.3)
    assert (chain.at(True, True, 2.0), chain.at(False, True, 2.0)) == pytest.approx(twice)
    assert chain.at(False, False, 2.0) == pytest.approx(1.0 - 0.8**2)
    assert chain.at(True, True, 1e3) == pytest.approx(rate)
    assert chain.at(None, False, 2.0) == 0.5


def test_a_file_is_read_as_it_was_written(errors: Errors, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    write_model(path, model_of(errors))
    assert read_model(path) == model_of(errors)
    write_model(path, model_of(errors))  # one of our own files, which may be replaced


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda raw: raw.update(format="other"), "format"),
        (lambda raw: raw.update(interval_s=0.0), "interval_s"),
        (lambda raw: raw["conditions"][0]["cells"].pop(), "cells"),
        (lambda raw: raw["conditions"][0]["cells"][0]["found"]["first"].update(p=1.5), "first.p"),
        (lambda raw: raw["conditions"][0]["ghosts"].update(examples=[]), "ghosts.examples"),
        (lambda raw: raw["conditions"][0]["doubles"]["there"][0]["first"].update(p=0.5), "doubles.examples"),
        (lambda raw: raw["conditions"][0]["cells"][-1]["errors"]["score"].reverse(), "score"),
        (lambda raw: raw.update(classes=["car", "tank"]), "classes"),
        (lambda raw: raw.clear(), "field"),
    ],
)
def test_a_wrong_file_is_one_line(
    errors: Errors, tmp_path: Path, change: Callable[[dict[str, Any]], object], field: str
) -> None:
    raw = msgspec.to_builtins(model_of(errors))
    raw = msgspec.json.decode(msgspec.json.encode(raw))
    change(raw)
    path = tmp_path / "model.json"
    path.write_bytes(msgspec.json.encode(raw))
    with pytest.raises(DataError, match=field) as wrong:
        read_model(path)
    assert "\n" not in str(wrong.value)
    path.write_bytes(msgspec.json.encode(raw | {"format": "dsrc error model 3"}))
    with pytest.raises(DataError, match="another version made it: run dsrc model fit again"):
        read_model(path)
    path.write_bytes(b"\x80\x04no json")
    with pytest.raises(DataError, match="error model"):
        read_model(path)


def test_a_condition_that_was_not_recorded_is_named(errors: Errors) -> None:
    model = model_of(errors)
    assert model.errors("m.json", Condition(), "its-g5-6") is errors  # alone: any channel
    with pytest.raises(SettingsError, match=r"m\.json: conditions: expected one of clean .*, found fog 3"):
        model.errors("m.json", Condition("fog", 3), "ideal")


def test_what_was_never_found_is_told_from_what_was_lost() -> None:
    stubborn = [sequence(seed, sight="clear") for seed in range(3)]
    blind = [replace(one, found=one.found[:0], score=one.score[:0]) for one in sequence(9)]
    cell = cell_of(fit_errors([*stubborn, blind, blind, blind], INTERVAL_S), "car", "clear", (15.0, 30.0))
    assert cell.found.not_yet.p < 0.1
    assert cell.found.after_no.p > percepts.AFTER_MISSED - 0.1
