"""Sizes and looks that road users of worlds of version 2 are drawn from, beside published figures."""

import numpy as np
import pytest

from sim.bodies.fleet import Fleet
from sim.bodies.varied.looks import LOOKS
from sim.bodies.varied.types import REACH, VARIED
from sim.bodies.vehicle_types import TYPES
from sim.boxes import CLASSES
from sim.mesh.materials import MATERIALS, material_index

PUBLISHED = {
    "car": [(3.88, 1.63, 1.53), (4.63, 1.97, 1.74), (4.73, 2.08, 1.77), (4.75, 1.92, 1.71)],
    "van": [(5.07, 1.90, 2.21)],
    "truck": [(10.14, 2.59, 3.25), (6.93, 2.51, 2.84), (10.24, 2.84, 3.44)],
    "bus": [(10.5, 2.94, 3.47), (12.70, 2.92, 3.42)],
    "motorcycle": [(2.11, 0.77, 1.47)],
    "bicycle": [(1.76, 0.60, 1.74), (1.81, 0.84, 1.77)],
    "pedestrian": [(0.84, 0.66, 1.76), (0.73, 0.67, 1.77), (0.91, 0.84, 1.74)],
}
"""Mean boxes of data sets, m; sources in `sim.bodies.varied.types`."""


def drawn(label: str, count: int = 1_500) -> np.ndarray:
    """(N, 3) sizes of road users of a class."""
    fleet, rng = Fleet(True, 3), np.random.default_rng(0)
    kinds = fleet.types_of(label)
    weights = np.array([kind.weight for kind in kinds])
    return np.array(
        [
            fleet.own(kinds[row], f"v{number}").size
            for number, row in enumerate(rng.choice(len(kinds), count, p=weights / weights.sum()))
        ]
    )


@pytest.mark.parametrize("label", CLASSES)
def test_mean_sizes_are_near_those_of_data_sets(label: str) -> None:
    """At most 10 % below the least and 15 % above the greatest published mean: riders make motorcycles taller."""
    published = np.array(PUBLISHED[label])
    mean = drawn(label).mean(axis=0)
    assert (mean > 0.90 * published.min(axis=0)).all() and (mean < 1.15 * published.max(axis=0)).all()


def test_lengths_of_cars_spread_as_in_real_streets() -> None:
    """KITTI: 0.43, 0.10, 0.14 m; 10 and 90 % of the lengths 3.2 to 4.4 m there and 4.0 to 4.9 m in Argoverse 2."""
    sizes = drawn("car")
    np.testing.assert_allclose(sizes.std(axis=0), [0.43, 0.10, 0.14], rtol=0.25)
    low, high = np.quantile(sizes[:, 0], [0.1, 0.9])
    assert 3.2 < low < 4.0 and 4.4 < high < 4.95
    assert len(np.unique(sizes[:, 0])) > 100


@pytest.mark.parametrize("label", CLASSES)
def test_sizes_are_bounded(label: str) -> None:
    kinds = [one for one in VARIED.values() if one.kind.label == label]
    sizes = drawn(label, 400)
    assert (sizes <= np.max([one.largest for one in kinds], axis=0) + 0.006).all()
    least = np.min([np.array(one.kind.size) - REACH * np.array(one.spread) for one in kinds], axis=0)
    assert (sizes >= least - 0.006).all() and (least > 0.2).all()


def test_a_long_car_is_a_wide_one() -> None:
    fleet = Fleet(True, 0)
    kind = VARIED["car_suv"].kind
    sizes = np.array([fleet.own(kind, f"v{number}").size for number in range(600)])
    assert (np.corrcoef(sizes.T)[np.triu_indices(3, 1)] > 0.3).all()


def test_types_of_version_2_drive_on_the_same_lanes() -> None:
    for label in CLASSES:
        assert {one.kind.vclass for one in VARIED.values() if one.kind.label == label} == {
            kind.vclass for kind in TYPES.values() if kind.label == label
        }


def test_looks_name_materials() -> None:
    for tables in LOOKS.values():
        for shares in tables:
            assert sum(shares.values()) == pytest.approx(1.0, abs=0.03)
            assert all(MATERIALS[material_index(name)].name == name for name in shares)


def test_half_of_the_cars_return_little() -> None:
    """Seen at random angles: white returns much, black and flakes little, as on real sensors (medians 0.00 to 0.08)."""
    from sensors.optics.reflectance import returned_power

    cosine = np.cos(np.linspace(0.0, np.radians(80.0), 200))
    (shares,) = LOOKS["paint"]
    power = np.concatenate(
        [
            np.repeat(returned_power(MATERIALS[material_index(name)], cosine), round(200 * share))
            for name, share in shares.items()
        ]
    )
    assert np.median(power) < 0.10 and np.quantile(power, 0.9) > 0.4
    silver = returned_power(MATERIALS[material_index("flakes_silver")], np.cos(np.radians([0.0, 55.0])))
    assert silver[0] > 1.0 and silver[1] < 0.08
