"""Background traffic: more vehicles, off the conflict, that touch nobody and stop for an ego that stops."""

from collections.abc import Iterable
from typing import Any

import msgspec
import numpy as np
import pytest

from sim.collisions import overlapping_pairs
from sim.encounters import ENCOUNTERS, encounter_of
from sim.scenario import EncounterSpec
from sim.traffic.script import FIRST_ID, ScriptedTraffic
from tests.sim.encounters.test_encounters import encounter

SEED = 1
QUICK = ("lta_truck", "roundabout_entry", "cut_in_merge", "ped_dartout")
"""Of the tests that drive every kind for seconds; the others are slow."""


def some(kinds: Iterable[str]) -> list:
    return [kind if kind in QUICK else pytest.param(kind, marks=pytest.mark.slow) for kind in kinds]


def names(kind: str, **conflict: Any) -> list[str]:
    layout = encounter_of(encounter(kind, **conflict), SEED).layout
    return [one.name for one in layout.actors if one.name.startswith("traffic_")]


@pytest.mark.parametrize("kind", ENCOUNTERS)
def test_dense_is_more_than_light_and_the_encounter_itself_stays_the_same(kind: str) -> None:
    light, dense = names(kind, traffic="light"), names(kind, traffic="dense")
    assert 0 < len(light) < len(dense)
    plain = encounter_of(encounter(kind), SEED).layout
    busy = encounter_of(encounter(kind, traffic="dense"), SEED).layout
    for one, other in zip(plain.actors, busy.actors, strict=False):
        assert (one.name, one.start_m, one.type_name) == (other.name, other.start_m, other.type_name)


@pytest.mark.parametrize("kind", some(ENCOUNTERS))
def test_nobody_touches_anybody_without_the_conflict(kind: str) -> None:
    with ScriptedTraffic(encounter(kind, traffic="dense", control="no_conflict"), SEED) as traffic:
        assert len(traffic.actors) > len(encounter_of(encounter(kind), SEED).layout.actors)
        while traffic.time_s < 10.0:
            assert len(overlapping_pairs(traffic.step().boxes)) == 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ima_building", "eebl_chain", "lta_truck"])
def test_nobody_rams_an_ego_that_stops_clear_of_the_conflict(kind: str) -> None:
    with ScriptedTraffic(encounter(kind, traffic="dense"), SEED) as traffic:
        while traffic.time_s < 12.0:
            traffic.command(FIRST_ID, max(traffic.speed(FIRST_ID) - 0.7, 0.0))
            traffic.step()
        assert not traffic.crashes and traffic.speed(FIRST_ID) == 0.0


def test_who_follows_the_conflict_actor_disappears_with_it() -> None:
    layout = encounter_of(encounter("eebl_chain", traffic="dense"), SEED).layout
    jam = {one.name for one in layout.actors if "jam" in one.roles}
    left = set(names("eebl_chain", traffic="dense", control="no_conflict"))
    assert jam and not jam & left and left


def test_without_the_setting_the_settings_of_a_drive_have_none() -> None:
    plain = EncounterSpec(kind="ima_building")
    assert "traffic" not in msgspec.to_builtins(plain)
    assert names("ima_building") == names("ima_building", traffic="none") == []


@pytest.mark.parametrize("kind", ["cut_in_merge", "eebl_chain", "ima_queue"])
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_who_drives_when_it_begins_has_driven_before(kind: str, seed: int) -> None:
    with ScriptedTraffic(encounter(kind, traffic="dense"), seed) as traffic:
        first, second = traffic.actors, traffic.step()
    assert np.abs(first.acceleration).max() < 12.0
    row = [second.row(int(one)) for one in first.boxes.object_id]
    np.testing.assert_allclose(first.velocity, second.velocity[row], atol=1.2)
