"""Road users of a scenario as functions of their names and the seed."""

import numpy as np
import pytest

from sim.bodies.choice import choose_model, require_model
from sim.bodies.fleet import Fleet
from sim.bodies.varied.types import VARIED
from sim.bodies.vehicle_types import TYPES
from sim.boxes import CLASSES
from sim.world.roads.swept import _LONG_M

OLD, NEW = Fleet(False, 5), Fleet(True, 5)


@pytest.mark.parametrize("name", sorted(TYPES))
def test_version_1_keeps_types_sizes_and_models(name: str) -> None:
    kind = TYPES[name]
    assert OLD.own(kind, "v7") is kind and OLD.by_id(name) is kind and OLD.largest(kind) == kind.size
    assert OLD.model(kind, "v7") == choose_model(kind.label, "v7", 5)
    assert OLD.types() == list(TYPES.values())


@pytest.mark.parametrize("name", sorted(VARIED))
def test_a_road_user_is_the_same_whoever_asks(name: str) -> None:
    kind = VARIED[name].kind
    own = NEW.own(kind, "v7")
    assert own == NEW.by_id(own.name) == Fleet(True, 5).own(kind, "v7")
    assert own.label == kind.label and own.accel_mps2 == kind.accel_mps2
    assert NEW.model(own, "v7") == Fleet(True, 5).model(own, "v7")
    assert NEW.model(own, "v7").startswith(f"{VARIED[name].shape}/")
    others = {NEW.own(kind, f"v{number}").size for number in range(12)}
    assert len(others) > 8
    assert Fleet(True, 6).own(kind, "v7").size != own.size


@pytest.mark.parametrize("name", sorted(TYPES))
def test_a_body_of_given_size_has_a_shape_that_fits(name: str) -> None:
    """Actors of encounters keep the sizes that their script needs."""
    kind = TYPES[name]
    models = [NEW.model(kind, f"actor{number}") for number in range(20)]
    for model in models:
        require_model(model)
    assert len(set(models)) > 3
    length, height = kind.size[0], kind.size[2]
    for model in models:
        fitting = [one.kind.size for one in VARIED.values() if model.startswith(f"{one.shape}/")]
        assert min(abs(np.log(size[0] / size[2] * height / length)) for size in fitting) < 0.6, model


def test_a_long_lorry_has_a_trailer() -> None:
    from dataclasses import replace

    long = replace(TYPES["truck_heavy"], size=(16.4, 2.55, 3.9))
    assert all(NEW.model(long, f"t{number}").startswith("semi_trailer/") for number in range(5))


def test_no_vehicle_is_longer_than_the_ground_that_junctions_keep_free() -> None:
    """16.5 m, the longest that directive 96/53/EC allows a tractor with its semi-trailer."""
    longest = max(kind.largest[0] for kind in VARIED.values())
    assert 16.4 < longest <= _LONG_M.max() == 16.5


def test_types_share_the_weight_of_their_class() -> None:
    for label in CLASSES:
        assert np.isclose(sum(kind.weight for kind in NEW.types_of(label)), 1.0)
