"""Augmentation moves points and boxes together and stays inside the grid."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as replace_setting

from dsrc.data.sample import Sample, inside_range, make_sample
from dsrc.models.inputs.batch import collate
from dsrc.models.layers.encoder import Pillars
from dsrc.training.augmentation.augment import augment, source_grid, thinned, with_some
from dsrc.training.recipes import Augmentation, debug
from tests.dsrc.training.drive import frame

GRID = debug().model.grid
WHOLE = Augmentation()
STILL = Augmentation(flip=False, rotation_deg=0, scale=0, random_ego=False, dropout=0)


@pytest.fixture(scope="module")
def sample() -> Sample:
    return make_sample(frame(0), 1000, source_grid(GRID, Augmentation()))


def points_in_boxes(sample: Sample) -> int:
    return sum(int(sample.boxes.contains(cloud[:, :3], margin=0.02).any(axis=0).sum()) for cloud in sample.clouds)


def test_without_augmentation_a_sample_stays_as_it_is() -> None:
    whole = make_sample(frame(0), 1000, GRID)
    same = augment(whole, GRID, STILL, np.random.default_rng(0))
    np.testing.assert_array_equal(same.clouds[1], whole.clouds[1])
    np.testing.assert_allclose(same.boxes.array, whole.boxes.array)


@pytest.mark.parametrize("seed", range(4))
def test_points_stay_on_their_objects(sample: Sample, seed: int) -> None:
    # A margin around the grid keeps every car inside, so that the counts can be compared.
    wide = source_grid(source_grid(GRID, Augmentation()), Augmentation())
    moved = augment(sample, wide, replace_dropout(0.0), np.random.default_rng(seed))
    assert abs(points_in_boxes(moved) - points_in_boxes(sample)) <= 2
    assert not np.allclose(moved.boxes.center, sample.boxes.center)


def test_what_is_lifted_into_the_grid_was_read_and_what_it_belongs_to_too() -> None:
    low, high = GRID.range_m[2], GRID.range_m[5]
    for change in ({"height_m": 0.4}, {"height_m": 0.4, "rotation_deg": 0.0, "scale": 0.0}):
        read = source_grid(GRID, Augmentation(**change)).range_m
        assert (read[2], read[5]) == pytest.approx((low - 0.4, high + 0.4))
    assert source_grid(GRID, STILL) == GRID


@pytest.mark.parametrize("scale", [0.0, 0.05, 0.5])
@pytest.mark.parametrize("limit", [0.0, 15.0, 26.0, 60.0, 120.0])
def test_whatever_ends_in_the_grid_was_read(limit: float, scale: float) -> None:
    read = source_grid(GRID, Augmentation(rotation_deg=limit, scale=scale)).range_m
    x, y = np.meshgrid(GRID.range_m[::3], GRID.range_m[1::3])
    corners = x.ravel() + 1j * y.ravel()
    turns = np.exp(1j * np.radians(np.linspace(-limit, limit, 721)))
    before = corners[:, None] * turns / (1 - scale)
    # No more than needed: a step of two cells.
    for reach, high in ((np.abs(before.real).max(), read[3]), (np.abs(before.imag).max(), read[4])):
        assert reach - 1e-6 <= high <= reach + 2 * GRID.cell_m + 1e-3


def replace_dropout(dropout: float) -> Augmentation:
    return Augmentation(flip=True, rotation_deg=15, scale=0.05, random_ego=True, dropout=dropout)


def test_everything_ends_inside_the_grid(sample: Sample) -> None:
    moved = augment(sample, GRID, Augmentation(), np.random.default_rng(1))
    low, high = np.array(GRID.range_m[:3]), np.array(GRID.range_m[3:])
    assert all(((cloud[:, :3] > low) & (cloud[:, :3] < high)).all() for cloud in moved.clouds)
    assert inside_range(moved.boxes, GRID).all()


def test_a_dropped_agent_takes_with_it_what_only_it_has_seen(sample: Sample) -> None:
    alone = with_some(sample, [0])
    assert len(alone.clouds) == 1
    assert set(alone.boxes.object_id) == set(sample.agent_boxes[0].object_id)
    assert len(alone.boxes) < len(sample.boxes)


@pytest.mark.parametrize("seed", range(6))
def test_the_teacher_has_the_same_clouds_of_those_who_are_kept_whether_others_are_dropped_or_not(
    sample: Sample, seed: int
) -> None:
    settings = replace_setting(debug().model, max_points=10_000, rec=False)
    all_agents, few = (augment(sample, GRID, replace_dropout(p), np.random.default_rng(seed)) for p in (0.0, 1.0))
    whole, part = (collate([s], settings, training=True) for s in (all_agents, few))
    assert len(few.clouds) + len(few.other_clouds) == len(all_agents.clouds) == 3
    assert part.teacher.clouds == part.student.clouds == len(few.clouds)
    for row, agent in enumerate(few.agent_ids):
        expected = points_of(whole.teacher, all_agents.agent_ids.index(agent))
        np.testing.assert_array_equal(in_order(points_of(part.teacher, row)), in_order(expected))


def points_of(pillars: Pillars, cloud: int) -> np.ndarray:
    return pillars.points[pillars.coords[pillars.pillar, 0] == cloud].numpy()


def in_order(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(points.T)]


def test_every_collaborator_is_dropped_now_and_then_but_never_the_ego(sample: Sample) -> None:
    rng = np.random.default_rng(3)
    kept = {augment(sample, GRID, replace_dropout(1.0), rng).agent_ids for _ in range(60)}
    ego, one, two = sample.agent_ids
    assert kept == {(ego,), (ego, one), (ego, two), (ego, one, two)}


def test_an_ego_alone_has_its_own_cloud_and_what_it_has_seen(sample: Sample) -> None:
    alone = Augmentation(flip=False, rotation_deg=0, scale=0, dropout=0, alone=1)
    for seed in range(4):
        few = augment(sample, GRID, alone, np.random.default_rng(seed))
        assert few.agent_ids == sample.agent_ids[:1] and len(few.clouds) == 1 and len(few.other_clouds) == 2
        assert set(few.boxes.object_id.tolist()) == set(few.agent_boxes[0].object_id.tolist())
    part = {
        augment(sample, GRID, replace_setting(alone, alone=0.5), np.random.default_rng(seed)).agent_ids
        for seed in range(20)
    }
    assert part == {sample.agent_ids[:1], sample.agent_ids}


def test_equal_seeds_make_equal_samples(sample: Sample) -> None:
    a, b = (augment(replace(sample), GRID, Augmentation(), np.random.default_rng(9)) for _ in range(2))
    assert all(np.array_equal(x, y) for x, y in zip(a.clouds, b.clouds, strict=True))


def test_a_thinned_student_sees_some_of_its_points_and_its_teacher_all(sample: Sample) -> None:
    thin = thinned(sample, np.random.default_rng(1))
    for seen, cloud in zip(thin.corrupted, sample.clouds, strict=True):
        assert 0.05 * len(cloud) < len(seen) < len(cloud)
        assert {tuple(point) for point in seen.tolist()} <= {tuple(point) for point in cloud.tolist()}
    for ours, theirs in zip(thin.clouds, sample.clouds, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_thinning_changes_nothing_else_of_a_sample(sample: Sample) -> None:
    choice = Augmentation(thinning=1.0)
    thin, whole = (augment(sample, GRID, a, np.random.default_rng(5)) for a in (choice, Augmentation()))
    assert thin.corrupted and not whole.corrupted
    for ours, theirs in zip(thin.clouds, whole.clouds, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(thin.boxes.array, whole.boxes.array)


def test_a_lifted_sample_is_the_scene_from_another_height(sample: Sample) -> None:
    lifts = set()
    for seed in range(4):
        raised, level = (
            augment(sample, GRID, choice, np.random.default_rng(seed)) for choice in (Augmentation(height_m=0.4), WHOLE)
        )
        shared = np.isin(raised.boxes.object_id, level.boxes.object_id)
        before = level.boxes[np.isin(level.boxes.object_id, raised.boxes.object_id)]
        move = raised.boxes[shared].center - before.center
        np.testing.assert_allclose(move[:, :2], 0.0, atol=1e-9)
        assert np.ptp(move[:, 2]) < 1e-9 and 0 < abs(move[0, 2]) <= 0.4
        # Points went with their boxes, and the road with them.
        assert np.median(raised.clouds[0][:, 2]) - np.median(level.clouds[0][:, 2]) == pytest.approx(
            move[0, 2], abs=0.05
        )
        assert abs(points_in_boxes(raised) - points_in_boxes(level)) <= 2
        lifts.add(round(float(move[0, 2]), 6))
    assert len(lifts) == 4
