"""Augmentation moves points and boxes together and stays inside the grid."""

from dataclasses import replace

import numpy as np
import pytest

from dsrc.data.sample import Sample, inside_range, make_sample
from dsrc.training.augment import augment, source_grid, with_agents
from dsrc.training.recipes import Augmentation, debug
from tests.dsrc.training.drive import frame

GRID = debug().model.grid
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


def replace_dropout(dropout: float) -> Augmentation:
    return Augmentation(flip=True, rotation_deg=15, scale=0.05, random_ego=True, dropout=dropout)


def test_everything_ends_inside_the_grid(sample: Sample) -> None:
    moved = augment(sample, GRID, Augmentation(), np.random.default_rng(1))
    low, high = np.array(GRID.range_m[:3]), np.array(GRID.range_m[3:])
    assert all(((cloud[:, :3] > low) & (cloud[:, :3] < high)).all() for cloud in moved.clouds)
    assert inside_range(moved.boxes, GRID).all()


def test_a_dropped_agent_takes_with_it_what_only_it_has_seen(sample: Sample) -> None:
    alone = with_agents(sample, [0])
    assert len(alone.clouds) == 1
    assert set(alone.boxes.object_id) == set(sample.agent_boxes[0].object_id)
    assert len(alone.boxes) < len(sample.boxes)


def test_every_collaborator_is_dropped_now_and_then_but_never_the_ego(sample: Sample) -> None:
    rng = np.random.default_rng(3)
    kept = {augment(sample, GRID, replace_dropout(1.0), rng).agent_ids for _ in range(60)}
    ego, one, two = sample.agent_ids
    assert kept == {(ego,), (ego, one), (ego, two), (ego, one, two)}


def test_equal_seeds_make_equal_samples(sample: Sample) -> None:
    a, b = (augment(replace(sample), GRID, Augmentation(), np.random.default_rng(9)) for _ in range(2))
    assert all(np.array_equal(x, y) for x, y in zip(a.clouds, b.clouds, strict=True))
