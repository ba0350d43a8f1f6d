"""Road users of worlds of version 2 in SUMO: each of its own size, none in another."""

from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from sim.bodies.fleet import Fleet
from sim.bodies.varied.shapes import is_varied
from sim.bodies.varied.types import VARIED
from sim.boxes import CLASSES
from sim.catalog.load import load_scenario
from sim.collisions import overlapping_pairs
from sim.roads.networks import read_network, resolve_network
from sim.scenario import Scenario
from sim.traffic.base import PARKED, Actors
from sim.traffic.parking import BAY_M, parked_cars
from sim.traffic.sumo.traffic import SumoTraffic

SEED, STEPS = 2, 300


def varied(name: str) -> Scenario:
    """A shipped scenario in a world of version 2."""
    return msgspec.structs.replace(load_scenario(name), world=2, warmup_s=20.0)


@pytest.fixture(scope="module")
def run() -> Iterator[list[Actors]]:
    """Every tenth instant of half a minute."""
    with SumoTraffic(varied("four_way"), SEED) as traffic:
        yield [traffic.step() for _ in range(STEPS)][::10]


def test_every_road_user_has_a_size_and_a_shape_of_its_own(run: list[Actors]) -> None:
    size = {
        name: tuple(row) for actors in run for name, row in zip(actors.name, actors.boxes.size.tolist(), strict=True)
    }
    models = {name: model for actors in run for name, model in zip(actors.name, actors.model, strict=True)}
    assert len(size) > 40 and len(set(size.values())) > 0.8 * len(size)
    assert all(is_varied(model) for model in models.values()) and len(set(models.values())) > 20
    labels = {CLASSES[label] for actors in run for label in actors.boxes.label.tolist()}
    assert {"car", "bicycle", "pedestrian"} <= labels


def test_sizes_and_models_are_functions_of_name_and_seed(run: list[Actors]) -> None:
    fleet = Fleet(True, SEED)
    for actors in run[:3]:
        for name, model, size in zip(actors.name, actors.model, actors.boxes.size.tolist(), strict=True):
            fitting = [fleet.own(one.kind, name) for one in VARIED.values()]
            own = [kind for kind in fitting if kind.size == tuple(size)]
            assert own and any(fleet.model(kind, name) == model for kind in own)


def test_bodies_hardly_ever_overlap(run: list[Actors]) -> None:
    """SUMO keeps the gaps of each one's own length, so that nobody stands in the one ahead."""
    rows = [actors.boxes[actors.boxes.is_vehicle] for actors in run]
    assert np.mean([len(overlapping_pairs(boxes)) for boxes in rows]) < 0.1


@pytest.mark.slow
def test_parked_cars_keep_to_their_bays() -> None:
    scenario = varied("berlin")
    cars = parked_cars(scenario, read_network(resolve_network(scenario, SEED)), SEED)
    assert len(cars) > 30
    sizes = np.array([kind.size for kind in cars.kind])
    assert (sizes[:, 0] <= BAY_M[0] - 0.59).all() and (sizes[:, 1] <= BAY_M[1]).all()
    assert len(np.unique(sizes[:, 0])) > 15
    assert [kind.name.partition("~")[2] for kind in cars.kind] == [f"{PARKED}{row}" for row in range(len(cars))]
