"""Samples on level ground: what is level stays, a slope comes out level, and boxes come back where they were."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dsrc.data.level import joined, level, raised, taller
from dsrc.data.sample import Sample, make_sample
from dsrc.detectors.levelled import LevelledDetector
from dsrc.models.detector import Detector
from dsrc.models.joined import JoinedDetectors
from dsrc.models.settings import ModelSettings
from dsrc.models.teams import team_detections, teams_of
from dsrc.ops.grid import GridSpec
from dsrc.training.recipes import debug
from sim.boxes import Boxes
from sim.errors import SettingsError
from tests.dsrc.training.drive import frame

GRID = GridSpec((-25.6, -12.8, -3.0, 25.6, 12.8, 1.0))
SETTINGS = msgspec.structs.replace(debug().settings("plain"), grid=GRID, height="ground", score_threshold=0.0)
CARS = np.array([[8.0, 3.0], [-12.0, -4.0], [18.0, -6.0]])


def cloud(seed: int, slope: float, height_m: float) -> NDArray[np.float32]:
    """Return points of a road with a slope along x below a LiDAR at a height, and of cars on it."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((-25, -12), (25, 12), (9000, 2))
    cars = (CARS[:, None] + rng.uniform((-2.1, -0.9), (2.1, 0.9), (3, 300, 2))).reshape(-1, 2)
    z = np.concatenate([rng.normal(0, 0.02, len(xy)), rng.uniform(0.3, 1.5, len(cars))])
    places = np.concatenate([xy, cars])
    made = np.column_stack([places, z + slope * places[:, 0] - height_m, rng.uniform(0, 1, len(places))])
    return made.astype(np.float32)


def sample(slope: float = 0.0, heights: tuple[float, ...] = (1.9,)) -> Sample:
    """Return a sample of agents whose clouds lie too high or low by errors of their poses; boxes on the ego's road."""
    boxes = Boxes.from_array([[x, y, slope * x - heights[0] + 0.8, 4.2, 1.8, 1.6, 0.3] for x, y in CARS])
    poses = np.stack([np.eye(4)] * len(heights))
    clouds = tuple(cloud(k, slope, height) for k, height in enumerate(heights))
    return Sample("toy", tuple(range(1, len(heights) + 1)), clouds, poses, boxes, (boxes,) * len(heights))


def network(settings: ModelSettings = SETTINGS) -> Detector:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Detector(settings).eval()


def road(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the heights of those of the points of `cloud` that lie on the road; boxes of cars are left out."""
    near = (np.abs(points[:, None, :2] - CARS) < (3.0, 1.5)).all(axis=2).any(axis=1)
    return points[~near, 2]


def test_a_flat_world_is_left_as_it_is_within_its_noise() -> None:
    flat = sample()
    level_ = level(flat, GRID)
    assert len(level_.clouds[0]) == len(flat.clouds[0])
    assert np.abs(level_.clouds[0][:, 2] - flat.clouds[0][:, 2]).max() < 0.05
    assert np.abs(level_.boxes.center - flat.boxes.center).max() < 0.05


@pytest.mark.parametrize("slope", [0.05, -0.1])
def test_a_slope_comes_out_level_under_every_agent(slope: float) -> None:
    # The second agent believes that it stands 0.5 m lower than it does.
    found = level(sample(slope, (1.7, 2.2)), GRID)
    for points in found.clouds:
        assert np.abs(np.median(road(points)) + 1.9) < 0.03 and road(points).std() < 0.06
    assert found.boxes.center[:, 2] == pytest.approx(-1.9 + 0.8, abs=0.08)
    assert level(found, GRID) is found


def test_boxes_come_back_exactly() -> None:
    before = sample(0.07, (1.7, 2.2))
    after = level(before, GRID)
    back = raised(after.boxes, joined(after.grounds))
    assert np.abs(back.center - before.boxes.center).max() < 1e-12 and np.array_equal(
        back.array[:, 3:], before.boxes.array[:, 3:]
    )


def test_where_the_ego_sees_no_ground_that_of_another_counts() -> None:
    both = sample(0.1, (1.9, 1.9))
    near = replace(both, clouds=(both.clouds[0][np.abs(both.clouds[0][:, 0]) < 6], both.clouds[1]))
    at = joined(level(near, GRID).grounds).at(np.array([[20.0, 0.0], [0.0, 0.0]]))
    assert at == pytest.approx([0.1, -1.9], abs=0.1)
    assert joined(level(near, GRID).grounds[:1]).at(np.array([[20.0, 0.0]]))[0] < -0.8


def test_without_any_ground_nothing_moves_and_an_agent_that_sees_it_says_where_it_is() -> None:
    both, few = sample(0.1, (1.6, 1.6)), cloud(3, 0.0, 1.6)[::3000]
    blind = replace(both, clouds=(few, both.clouds[1]))
    alone = level(replace(blind, clouds=(few,), agent_boxes=both.agent_boxes[:1]), GRID)
    assert len(few) == 4 and np.array_equal(alone.clouds[0], few)
    assert np.array_equal(alone.boxes.center, both.boxes.center)
    assert level(blind, GRID).boxes.center[:, 2] == pytest.approx(-1.9 + 0.8, abs=0.12)


def test_on_flat_ground_levelled_detectors_are_judged_on_the_same_boxes() -> None:
    plain = msgspec.structs.replace(SETTINGS, height="sensor")
    wanted, *others = (
        make_sample(frame(0), None, settings.request).boxes.array
        for settings in (plain, SETTINGS, LevelledDetector(network(plain), "auto").settings)
    )
    assert len(wanted) > 1
    for found in others:
        assert np.array_equal(found, wanted)


def test_a_network_of_heights_above_the_ground_levels_and_puts_back_by_itself() -> None:
    uneven = sample(0.08, (1.7, 2.2))
    flat_one = network(msgspec.structs.replace(SETTINGS, height="sensor"))
    own = network()
    flat_one.load_state_dict(own.state_dict())
    seen = level(uneven, GRID)
    wanted, found = flat_one.detect(seen), own.detect(uneven)
    assert len(found) > 20
    rows = np.flatnonzero(np.isin(wanted.score, found.score))
    on_slope = raised(wanted[rows].boxes, joined(seen.grounds)).array
    assert len(rows) > 20
    assert np.array_equal(on_slope[:, :2], found.boxes.array[: len(rows), :2])
    assert np.allclose(on_slope, found.boxes.array[: len(rows)])
    # The range that counts is as high as the hills, for true boxes too.
    assert own.settings.request.grid == taller(GRID) and own.settings.request.judged_m[2] == GRID.range_m[2] - 12


def test_each_team_has_what_it_would_have_alone() -> None:
    three = sample(0.05, (1.7, 2.2, 1.9))
    detector = network(msgspec.structs.replace(SETTINGS, fusion="max"))
    for team, found in zip(teams_of(3), team_detections(detector, three), strict=True):
        alone = replace(
            three,
            agent_ids=tuple(three.agent_ids[k] for k in team),
            clouds=tuple(three.clouds[k] for k in team),
            ego_from_agent=three.ego_from_agent[list(team)],
            agent_boxes=tuple(three.agent_boxes[k] for k in team),
        )
        wanted = detector.detect(alone)
        assert len(wanted) == len(found) and np.allclose(wanted.boxes.array, found.boxes.array, atol=1e-3)


def test_what_has_no_meaning_is_refused() -> None:
    with pytest.raises(ValueError, match="height: expected sensor with own_frame, found ground"):
        msgspec.structs.replace(SETTINGS, own_frame=True, fusion="max")
    people = msgspec.structs.replace(SETTINGS, users="vulnerable")
    with pytest.raises(SettingsError, match="grid: expected a range within"):
        JoinedDetectors([network(msgspec.structs.replace(SETTINGS, height="sensor")), network(people)])
