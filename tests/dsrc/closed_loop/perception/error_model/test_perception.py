"""Error model as a perception: one seed, one run; sight by lines; persistence; fitting its percepts gives it back."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dsrc.closed_loop.campaign.jobs import episodes_of
from dsrc.closed_loop.campaign.read import campaign_of
from dsrc.closed_loop.perception.error_model.fit import fit_errors
from dsrc.closed_loop.perception.error_model.model import Chain, Doubles, ErrorModel, Errors, write_model
from dsrc.closed_loop.perception.error_model.perception import ModelPerception
from dsrc.closed_loop.perception.error_model.percepts import Observed
from dsrc.closed_loop.perception.error_model.sight import SIGHTS, Viewpoints, quarters_of
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Percept
from dsrc.options.driving import DriveOptions
from sim.errors import SettingsError
from tests.dsrc.closed_loop.perception import toy
from tests.dsrc.closed_loop.perception.error_model import percepts
from tests.dsrc.closed_loop.perception.error_model.percepts import INTERVAL_S, sequence

AREA = (-100.0, -60.0, 100.0, 60.0)


@pytest.fixture(scope="module")
def fitted() -> Errors:
    """Cars in clear view with known errors; hidden ones are never found."""
    hidden = [replace(one, found=one.found[:0], score=one.score[:0]) for one in sequence(99, sight="hidden")]
    return msgspec.structs.replace(fit_errors([*map(sequence, range(20)), hidden], INTERVAL_S), area_m=AREA)


def model_of(errors: Errors, cooperative: bool = False) -> ErrorModel:
    return ErrorModel(
        perception="by hand",
        cooperative=cooperative,
        interval_s=INTERVAL_S,
        classes=("car",),
        conditions=(errors,),
    )


def percepts_of(errors: Errors, seed: int, steps: int, cooperative: bool = False) -> list[Percept]:
    perception = ModelPerception(model_of(errors, cooperative), errors)
    perception.reset(toy.SCENARIO, toy.EGO, seed)
    return [perception.perceive(toy.instant(step - 1), toy.instant(step), {}) for step in range(1, steps + 1)]


@pytest.fixture(autouse=True)
def _world(monkeypatch: pytest.MonkeyPatch) -> None:
    toy.build(monkeypatch)


def test_sight_knows_the_wall_and_who_sees_around_it() -> None:
    now, rows = toy.instant(1), np.array([1, 2, 3])  # helper, near, hidden
    alone = Viewpoints(toy.SCENARIO, 0, toy.EGO, cooperative=False).sight(now, now, rows)
    together = Viewpoints(toy.SCENARIO, 0, toy.EGO, cooperative=True).sight(now, now, rows)
    assert SIGHTS[alone[1]] == "clear"
    assert SIGHTS[alone[2]] == "hidden"
    assert SIGHTS[together[2]] == "helpers"


def test_one_seed_is_one_run(fitted: Errors) -> None:
    first, again, other = (percepts_of(fitted, seed, 30) for seed in (0, 0, 1))
    for one, two in zip(first, again, strict=True):
        assert np.array_equal(one.boxes.array, two.boxes.array)
        assert np.array_equal(one.score, two.score)
    assert any(len(one.boxes) != len(two.boxes) for one, two in zip(first, other, strict=True))


def test_what_nobody_sees_is_not_found(fitted: Errors) -> None:
    quiet = msgspec.structs.replace(fitted, ghosts=msgspec.structs.replace(fitted.ghosts, born=0.0))
    hidden = toy.instant(1).boxes.center[3]
    for percept in percepts_of(quiet, 0, 40):
        assert (np.linalg.norm(percept.boxes.center - hidden, axis=1) > 5.0).all()


@pytest.mark.slow
def test_misses_persist_and_a_fit_of_the_percepts_gives_the_model_back(fitted: Errors) -> None:
    ego, others = np.zeros(3), np.array([1, 2])  # both in clear view
    sequences = []
    for seed in range(12):
        seen = [
            Observed(
                percept.time_s,
                ego,
                toy.instant(1).boxes[others],
                np.full(2, SIGHTS.index("clear")),
                percept.boxes,
                percept.score,
            )
            for percept in percepts_of(fitted, seed, 150)
        ]
        sequences.append(seen)
    again = fit_errors(sequences, INTERVAL_S)
    cell = next(one for one in again.cells if one.sight == "clear" and one.kind == "car")
    assert cell.found.after_yes.p == pytest.approx(percepts.AFTER_FOUND, abs=0.04)
    assert cell.found.after_no.p == pytest.approx(percepts.AFTER_MISSED, abs=0.06)
    assert np.allclose(cell.errors.sd, percepts.SD, rtol=0.2)
    assert np.allclose(again.correlation[:7], percepts.CORRELATION, atol=0.06)
    assert again.ghosts.born == pytest.approx(percepts.BORN, abs=0.12)


@pytest.mark.parametrize("crossing", [False, True])
def test_boxes_lie_across_the_objects_that_are_said_to(fitted: Errors, crossing: bool) -> None:
    never = fitted.crossed[0]
    always = certain(never, 1.0)
    assert never.first.p == 0.0
    errors = msgspec.structs.replace(fitted, crossed=(never, always) if crossing else (always, never))
    truth = toy.instant(1).boxes
    ego = truth.yaw[truth.object_id == toy.EGO][0]
    seen = 0
    for percept in percepts_of(errors, 0, 20):
        for box in percept.boxes.array:
            apart = np.linalg.norm(truth.center[:, :2] - box[:2], axis=1)
            if apart.min() > 2.0:
                continue  # a ghost
            yaw = truth.yaw[apart.argmin()]
            is_crossed = bool(across(np.array(box[6] - yaw)))
            assert is_crossed == (bool(across(np.array(yaw - ego))) == crossing)
            seen += 1
    assert seen > 10


def test_second_boxes_lie_where_the_model_has_them(fitted: Errors) -> None:
    always = certain(fitted.flipped[0], 1.0)
    example = (2.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5 * np.pi, 0.21)
    errors = msgspec.structs.replace(fitted, doubles=Doubles(there=(always, always), examples=(example,)))
    once, twice = percepts_of(fitted, 0, 20), percepts_of(errors, 0, 20)
    truth = toy.instant(1).boxes
    cos, sin = np.cos(truth.yaw), np.sin(truth.yaw)
    places = truth.center[:, :2] + np.column_stack([2.0 * cos - sin, 2.0 * sin + cos])
    seconds = 0
    for one, two in zip(once, twice, strict=True):
        second = two.boxes[two.score == 0.21]
        seconds += len(second)
        assert len(two.boxes) == len(one.boxes) + len(second)
        for box in second.array:
            apart = np.linalg.norm(places - box[:2], axis=1)
            assert apart.min() < 1e-6
            assert bool(across(np.array(box[6] - truth.yaw[apart.argmin()])))
    assert seconds > 10


def across(turn: np.ndarray) -> np.ndarray:
    return quarters_of(turn) % 2 == 1


def certain(chain: Chain, p: float) -> Chain:
    sure = msgspec.structs.replace(chain.first, p=p, low=p, high=p)
    return Chain(first=sure, not_yet=sure, after_yes=sure, after_no=sure)


def test_a_model_is_opened_by_its_file_and_by_its_condition(fitted: Errors, tmp_path: Path) -> None:
    path = tmp_path / "errors.json"
    write_model(path, model_of(fitted))
    assert isinstance(open_perception(str(path)), ModelPerception)
    assert isinstance(open_perception("model", checkpoint=path), ModelPerception)
    with pytest.raises(SettingsError, match="found fog 3"):
        open_perception(str(path), corruption="fog")
    with pytest.raises(SettingsError, match="checkpoint"):
        open_perception("model")


def test_a_campaign_names_a_model_by_its_content(fitted: Errors, tmp_path: Path) -> None:
    path = tmp_path / "errors.json"
    write_model(path, model_of(fitted))
    plan = campaign_of(DriveOptions(what="lta_truck", perception=(str(path),), seed=(0, 1)))
    jobs = episodes_of(plan)
    assert [(job.perception, job.uses, job.seed) for job in jobs] == [("errors", "model", 0), ("errors", "model", 1)]
    changed = msgspec.structs.replace(model_of(fitted), perception="another")
    write_model(path, changed)
    assert episodes_of(plan)[0].detector != jobs[0].detector
    with pytest.raises(SettingsError, match="found fog 3"):
        campaign_of(DriveOptions(what="lta_truck", perception=(str(path),), corruption=("fog",)))
