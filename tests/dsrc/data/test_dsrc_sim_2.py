"""dsrc-sim-2: uneven worlds, a few level ones, several sensors, and splits whose places training never sees."""

import re
from collections import Counter

import pytest

from dsrc.data.datasets.spec import DriveItem, expand, find_split_file, read_dataset
from sim.world.roads.relief import TOWN, draw_relief
from tests.dsrc.data.test_dsrc_sim import SAME_SITE
from tests.paths import ROOT


def items() -> list[DriveItem]:
    path = find_split_file("dsrc-sim-2")
    assert path is not None
    return expand(read_dataset(path), path)


def test_worlds_are_of_version_2_but_for_an_eighth_of_the_training() -> None:
    level = [item for item in items() if item.spec.scenario.world != 2]
    assert {(item.split, item.spec.scenario.world) for item in level} == {("train", 1)}
    assert sum(item.spec.frames for item in level) == 270
    # Their places are trained in both versions.
    uneven = {item.spec.scenario.name for item in items() if item.split == "train" and item.spec.scenario.world == 2}
    assert {item.spec.scenario.name for item in level} <= uneven


def test_splits_are_as_large_as_they_say() -> None:
    frames = Counter[str]()
    for item in items():
        frames[item.split] += item.spec.frames
    text = (ROOT / "scenarios" / "dsrc-sim-2" / "split.toml").read_text()
    said = {name.lower(): int(count.replace(",", "")) for name, count in re.findall(r"# (\w+): ([\d,]+) frames", text)}
    assert said == frames


def test_sensors_and_mounts_vary_in_training() -> None:
    rules = [item.spec.scenario.agents for item in items() if item.split == "train"]
    assert len({rule.lidar for rule in rules}) >= 6
    raised = [rule for rule in rules if rule.mount_xyz_m == (0.0, 0.0, 2.2)]
    assert raised and all(rule.mount_pitch_deg == pytest.approx(1.5) for rule in raised) and len(raised) < len(rules)


def test_in_uneven_worlds_cars_are_parked_along_the_kerbs_of_towns_but_in_encounters() -> None:
    for item in items():
        scenario = item.spec.scenario
        if scenario.world == 1:
            continue
        town = scenario.conflict is None and scenario.name not in ("motorway_a10", "highway")
        assert (scenario.demand.parked_per_km >= 90) == town, item.name


def test_no_place_of_the_held_back_splits_is_trained_or_validated_on() -> None:
    places: dict[bool, set[str]] = {True: set(), False: set()}
    for item in items():
        name = item.spec.scenario.name
        places[item.split in ("unseen", "hilly")].add(SAME_SITE.get(name, name))
    assert places[True] and places[True].isdisjoint(places[False])


def test_hilly_seeds_are_steep() -> None:
    seeds = {item.spec.seed for item in items() if item.split == "hilly"}
    assert seeds and all(draw_relief(seed, TOWN).steepest > 0.11 for seed in seeds)
