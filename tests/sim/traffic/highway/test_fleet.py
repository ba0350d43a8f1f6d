"""Vehicles of worlds of version 2 on highway-env's roads."""

import msgspec
import pytest

from sim.bodies.fleet import Fleet
from sim.bodies.varied.types import VARIED
from sim.catalog.load import load_scenario

pytest.importorskip("highway_env")


def test_vehicles_have_sizes_and_bodies_of_their_own() -> None:
    from sim.traffic.highway.traffic import HighwayTraffic

    scenario = msgspec.structs.replace(load_scenario("highway_env_merge"), world=2, warmup_s=2.0)
    with HighwayTraffic(scenario, 1) as traffic:
        actors = traffic.step()
    fleet, sizes = Fleet(True, 1), [tuple(size) for size in actors.boxes.size.tolist()]
    assert len(actors) > 3 and len(set(sizes)) == len(sizes)
    for name, model, size in zip(actors.name, actors.model, sizes, strict=True):
        kinds = [kind for one in VARIED.values() if (kind := fleet.own(one.kind, name)).size == size]
        assert any(fleet.model(kind, name) == model for kind in kinds)
