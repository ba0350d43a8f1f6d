"""Mix of road users that an import says."""

import pytest

from sim.catalog.mix import read_mix, with_mix
from sim.errors import SettingsError
from sim.scenario import DemandSpec

TOWN = DemandSpec(vehicles_per_hour=1000.0, bicycles_per_hour=80.0, persons_per_hour=300.0)


def test_two_wheelers_come_as_often_as_the_mix_says() -> None:
    demand = with_mix(TOWN, read_mix("car=2, motorcycle=7,bus=1, bicycle=0.5"))
    assert demand.type_mix == {"car": 2.0, "motorcycle": 7.0, "bus": 1.0}
    assert demand.vehicles_per_hour == 1000.0
    assert demand.bicycles_per_hour == pytest.approx(50.0) and demand.persons_per_hour == 300.0


def test_classes_without_a_way_stay_out() -> None:
    motorway = DemandSpec(type_mix={"car": 1.0, "truck": 1.0})
    demand = with_mix(motorway, read_mix("car=1,motorcycle=3,bicycle=4,pedestrian=9"))
    assert demand.type_mix == {"car": 1.0}
    assert demand.bicycles_per_hour == 0.0 and demand.persons_per_hour == 0.0


def test_no_mix_changes_nothing() -> None:
    assert read_mix("") == {} and with_mix(TOWN, {}) is TOWN


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("car=1,motorbike=2", "motorbike"),
        ("car=1,car=2", "at most once"),
        ("car=much", "car=WEIGHT"),
        ("car=nan", "car=WEIGHT"),
        ("car=-1", "car=WEIGHT"),
        ("motorcycle=1", "a weight of car above 0"),
    ],
)
def test_a_mix_that_cannot_be_is_told(text: str, said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        read_mix(text)
