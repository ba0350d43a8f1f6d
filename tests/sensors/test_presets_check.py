"""Registration and contract check of LiDARs."""

from importlib.metadata import EntryPoint

import msgspec
import pytest

from sensors.presets import LIDARS, get_lidar, register_sensor
from sensors.presets.check import check_sensor
from sensors.spec import LidarSpec
from sim.catalog.registry import Registry
from sim.errors import SettingsError

MINE = LidarSpec(name="mine-4", elevation_deg=(2.0, 0.0, -2.0, -8.0), columns=180)


@pytest.fixture
def lidars(monkeypatch: pytest.MonkeyPatch) -> Registry[LidarSpec]:
    """Presets that a test may add to."""
    monkeypatch.setattr(LIDARS, "_values", dict(LIDARS._values))
    return LIDARS


def test_a_registered_lidar_is_found_by_its_name(lidars: Registry[LidarSpec]) -> None:
    register_sensor(MINE)
    register_sensor(MINE)
    assert get_lidar("mine-4") is MINE
    assert "mine-4" in list(lidars)
    with pytest.raises(SettingsError, match="expected a new one"):
        register_sensor(msgspec.structs.replace(MINE, columns=90))


def test_an_entry_point_gives_a_lidar_and_a_wrong_one_says_so(
    lidars: Registry[LidarSpec], monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {"ours": MINE, "other": 3.14}
    points = {name: EntryPoint(name, f"{__name__}:{name}", lidars.group) for name in values}
    monkeypatch.setitem(lidars.__dict__, "_installed", points)
    monkeypatch.setattr(EntryPoint, "load", lambda self: values[self.name])
    assert get_lidar("ours") is MINE
    with pytest.raises(SettingsError, match=r"other: .* expected a LidarSpec, found float"):
        get_lidar("other")


@pytest.mark.parametrize("name", ["vlp-16", "livox-avia", "debug-16"])
def test_shipped_lidars_pass(name: str) -> None:
    check_sensor(name)


def test_a_lidar_need_not_be_registered() -> None:
    check_sensor(MINE)


def test_failures_have_one_line_each() -> None:
    blind = msgspec.structs.replace(MINE, name=" ", mount_xyz_m=(0.0, 0.0, -1.0), range_min_m=50.0, range_10_m=20.0)
    with pytest.raises(SettingsError) as error:
        check_sensor(blind)
    lines = str(error.value).splitlines()
    assert [line.partition(": ")[2].partition(":")[0] for line in lines] == ["name", "mount_xyz_m", "beam_range_m"]
    with pytest.raises(SettingsError, match="expected a LidarSpec, found dict"):
        check_sensor({"name": "mine"})  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="unknown lidar"):
        check_sensor("nothing")


def test_lost_beams_are_named() -> None:
    weak = msgspec.structs.replace(MINE, dropoff_rate=1.0)
    with pytest.raises(SettingsError, match=r"beams: expected returns .* found none in \[0, 1, 2, 3\]"):
        check_sensor(weak)
