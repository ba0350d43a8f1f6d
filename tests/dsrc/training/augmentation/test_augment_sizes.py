"""Vehicles of other sizes and intensities of other sensors in training: what changes, together, and what does not."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as replace_setting
from numpy.typing import NDArray

from dsrc.data.sample import Sample, make_sample
from dsrc.training.augmentation.augment import SHORTEST_M, SKIN_M, augment, rescaled, resized, source_grid
from dsrc.training.recipes import Augmentation, debug
from sim.boxes import CLASSES, Boxes
from sim.collisions import overlapping_pairs
from tests.dsrc.training.drive import frame

GRID = debug().model.grid
HIGH_M = 10.0
SEEDS = range(5)


@pytest.fixture(scope="module")
def sample() -> Sample:
    made = make_sample(frame(0), 1000, source_grid(GRID, Augmentation()))
    ego, *_ = made.clouds
    return replace(made, corrupted=tuple(cloud[::2] for cloud in made.clouds), other_clouds=(ego[::3],))


def all_clouds(sample: Sample) -> list[NDArray[np.float32]]:
    return [*sample.clouds, *sample.other_clouds, *sample.corrupted]


def of(*rows: tuple[float, ...], label: str = "car", points: NDArray[np.float64] | None = None) -> Sample:
    """Return a sample of boxes x, y, z, l, w, h, yaw and one cloud."""
    boxes = Boxes.from_array(rows, np.full(len(rows), CLASSES.index(label)), np.arange(len(rows)))
    cloud = np.zeros((0, 4), np.float32) if points is None else np.column_stack([points, points[:, 2]])
    return Sample("made", (0,), (cloud.astype(np.float32),), np.eye(4)[None], boxes, (boxes,))


def bottom(boxes: Boxes) -> NDArray[np.float64]:
    return np.asarray(boxes.center[:, 2] - 0.5 * boxes.size[:, 2])


def sized(sample: Sample, seed: int, sizes: float = 0.4) -> Sample:
    return resized(sample, HIGH_M, sizes, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", SEEDS)
def test_points_lie_in_the_resized_boxes_where_they_lay_in_the_old_ones(sample: Sample, seed: int) -> None:
    new = sized(sample, seed)
    assert (np.abs(new.boxes.size / sample.boxes.size - 1) > 0.01).any(axis=1).sum() >= 4
    for before, after in zip(all_clouds(sample), all_clouds(new), strict=True):
        inside = sample.boxes.contains(before[:, :3])
        assert inside.sum() > 100
        assert new.boxes.contains(after[:, :3], margin=1e-4)[inside].all()
        for box, own in enumerate(inside):
            old, moved = (local(b[box : box + 1], c[own]) for b, c in ((sample.boxes, before), (new.boxes, after)))
            np.testing.assert_allclose(moved, old, atol=1e-4)


def local(box: Boxes, cloud: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return points as shares of the box's sizes from the centre of its bottom."""
    offset = cloud[:, :3] - box.center
    c, s = np.cos(box.yaw[0]), np.sin(box.yaw[0])
    turned = [c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2]]
    return np.asarray(np.stack(turned, axis=1) / box.size + [0, 0, 0.5])


@pytest.mark.parametrize("seed", SEEDS)
def test_everything_else_stays_as_it_is_to_the_bit(sample: Sample, seed: int) -> None:
    before_all = [cloud.copy() for cloud in all_clouds(sample)]
    new = sized(sample, seed)
    for before, after, kept in zip(all_clouds(sample), all_clouds(new), before_all, strict=True):
        np.testing.assert_array_equal(before, kept)
        on = sample.boxes.contains(before[:, :3], margin=SKIN_M + 1e-6).any(axis=0)
        assert on.any() and not on.all()
        np.testing.assert_array_equal(after[~on], before[~on])
        np.testing.assert_array_equal(after[:, 3], before[:, 3])
    np.testing.assert_allclose(bottom(new.boxes), bottom(sample.boxes), atol=1e-9)
    np.testing.assert_array_equal(new.boxes.center[:, :2], sample.boxes.center[:, :2])
    np.testing.assert_array_equal(new.boxes.yaw, sample.boxes.yaw)
    np.testing.assert_array_equal(new.boxes.object_id, sample.boxes.object_id)


def test_one_vehicle_has_one_size_in_the_boxes_of_all_agents(sample: Sample) -> None:
    new = sized(sample, 1)
    for own, old in zip(new.agent_boxes, sample.agent_boxes, strict=True):
        np.testing.assert_array_equal(own.object_id, old.object_id)
        assert len(own) and (own.size != old.size).any()
        rows = [new.boxes.object_id.tolist().index(one) for one in own.object_id]
        np.testing.assert_array_equal(own.array, new.boxes[rows].array)


def test_the_ground_below_a_vehicle_stays_and_what_sticks_out_of_its_sides_goes_along() -> None:
    below, outside, far = [1.0, 0.5, -0.02], [2.05, 0.0, 1.0], [2.2, 0.0, 1.0]
    before = of((0, 0, 0.75, 4, 2, 1.5, 0), points=np.array([below, outside, far]))
    after = sized(before, 0)
    moved = (after.clouds[0] != before.clouds[0]).any(axis=1)
    assert moved.tolist() == [False, True, False]
    factor = (after.boxes.size / before.boxes.size)[0]
    np.testing.assert_allclose(after.clouds[0][1, :3], np.array(outside) * factor, rtol=1e-6)


def test_a_point_beside_two_vehicles_is_moved_with_the_nearer_one() -> None:
    two = of((0, 0, 1, 4, 2, 2, 0), (0, 2.1, 1, 4, 2, 2, 0), points=np.array([[1.5, 0.99, 1.0], [1.5, 1.11, 1.0]]))
    new = sized(two, 3)
    factor = new.boxes.size / two.boxes.size
    assert (factor[0] != factor[1]).all()
    for row, y in enumerate((0.0, 2.1)):
        expected = [1.5 * factor[row, 0], y + (two.clouds[0][row, 1] - y) * factor[row, 1], factor[row, 2]]
        np.testing.assert_allclose(new.clouds[0][row, :3], expected, rtol=1e-5)


def test_sizes_span_what_is_asked_for() -> None:
    rows = [(20.0 * i, 0.0, 1.0, 5.0, 2.0, 1.5, 0.1) for i in range(400)]
    before = of(*rows)
    factor = sized(before, 0, 0.4).boxes.size / before.boxes.size
    length, width, height = factor.T
    np.testing.assert_allclose(width, height)
    assert 0.6 <= width.min() < 0.62 and 1.18 < width.max() <= 1.2
    stretch = length / width
    assert 0.9 - 1e-9 <= stretch.min() < 0.92 and 1.08 < stretch.max() <= 1.1 + 1e-9


def test_no_vehicle_shrinks_below_a_length() -> None:
    rows = [(20.0 * i, 0.0, 1.0, 1.8 + 0.02 * i, 1.5, 1.5, 0.0) for i in range(60)]
    for seed in SEEDS:
        before = of(*rows)
        new = sized(before, seed, 0.5).boxes.size[:, 0]
        assert (new >= np.minimum(before.boxes.size[:, 0], SHORTEST_M) - 1e-9).all()
        assert (new < before.boxes.size[:, 0] - 0.01).any()


@pytest.mark.parametrize("seed", SEEDS)
def test_no_vehicle_grows_into_another(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = np.column_stack([rng.uniform(-25, 25, (60, 2)), np.full(60, 0.75), np.tile([4.4, 1.8, 1.5], (60, 1))])
    crowd = of(*np.column_stack([rows, rng.uniform(-3, 3, 60)]))
    new = sized(crowd, seed)
    old_pairs, new_pairs = ({tuple(p) for p in overlapping_pairs(s.boxes).tolist()} for s in (crowd, new))
    assert new_pairs <= old_pairs
    factor = new.boxes.size / crowd.boxes.size
    # Some grow, some keep their size, and no rule keeps what shrinks from shrinking.
    assert (factor > 1.01).any() and (factor == 1).all(axis=1).any() and (factor < 0.9).any()


def test_bumper_to_bumper_none_grows() -> None:
    queue = of(*[(4.45 * i, 0.0, 0.75, 4.4, 1.8, 1.5, 0.0) for i in range(20)])
    for seed in SEEDS:
        factor = sized(queue, seed).boxes.size / queue.boxes.size
        assert len(overlapping_pairs(sized(queue, seed).boxes)) == 0
        assert (factor < 1).any()


def test_no_vehicle_grows_out_of_the_ground_truth_through_the_ceiling() -> None:
    rows = [(20.0 * i, 0.0, 1.0, 5.0, 2.0, 2.0, 0.0) for i in range(60)]
    before = of(*rows)
    low, high = (resized(before, ceiling, 0.4, np.random.default_rng(0)) for ceiling in (2.2, HIGH_M))
    top = low.boxes.center[:, 2] + 0.5 * low.boxes.size[:, 2]
    assert 2.0 < top.max() <= 2.2 < (high.boxes.center[:, 2] + 0.5 * high.boxes.size[:, 2]).max()


@pytest.mark.parametrize("label", ["pedestrian", "bicycle", "motorcycle"])
def test_people_and_two_wheelers_keep_their_sizes(label: str) -> None:
    before = of((0, 0, 0.9, 1.8, 0.6, 1.8, 0.3), (9, 0, 0.9, 1.8, 0.6, 1.8, 0.3), label=label, points=np.eye(3))
    after = sized(before, 0)
    np.testing.assert_array_equal(after.boxes.array, before.boxes.array)
    np.testing.assert_array_equal(after.clouds[0], before.clouds[0])


def test_vehicles_of_one_id_keep_their_sizes() -> None:
    before = of(*[(20.0 * i, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0) for i in range(3)])
    unknown = replace(before.boxes, object_id=np.array([-1, -1, 7]))
    after = sized(replace(before, boxes=unknown, agent_boxes=(unknown[:2],)), 0)
    changed = (after.boxes.size != unknown.size).any(axis=1)
    assert changed.tolist() == [False, False, True]
    np.testing.assert_array_equal(after.agent_boxes[0].array, unknown[:2].array)


def test_a_sample_without_boxes_or_points_has_none_after() -> None:
    empty = sized(of(), 0)
    assert len(empty.boxes) == len(empty.agent_boxes[0]) == len(empty.clouds[0]) == 0


@pytest.mark.parametrize("seed", SEEDS)
def test_other_draws_do_not_depend_on_sizes_and_intensities(sample: Sample, seed: int) -> None:
    plain = Augmentation(dropout=0.5, thinning=0.5, height_m=0.2)
    both = replace_setting(plain, sizes=0.3, intensity=1.0)
    old, new = (augment(sample, GRID, choice, np.random.default_rng(seed)) for choice in (plain, both))
    assert old.agent_ids == new.agent_ids and len(old.corrupted) == len(new.corrupted)
    ground = [{tuple(p) for p in s.clouds[0][s.clouds[0][:, 2] < -1.5, :3].tolist()} for s in (old, new)]
    assert len(ground[0] & ground[1]) > 0.8 * len(ground[0]) > 100
    shared = np.intersect1d(old.boxes.object_id, new.boxes.object_id)
    assert len(shared)
    places = [s.boxes[np.isin(s.boxes.object_id, shared)].center[:, :2] for s in (old, new)]
    np.testing.assert_allclose(*places, atol=1e-9)


def test_without_sizes_and_intensities_nothing_is_touched(sample: Sample) -> None:
    rng = np.random.default_rng(0)
    assert resized(sample, HIGH_M, 0.0, rng) is sample
    assert rescaled(sample, 0.0, rng) is sample


def test_equal_seeds_make_equal_samples(sample: Sample) -> None:
    choice = Augmentation(sizes=0.3, intensity=1.0)
    a, b, c = (augment(sample, GRID, choice, np.random.default_rng(seed)) for seed in (9, 9, 10))
    assert all(np.array_equal(x, y) for x, y in zip(all_clouds(a), all_clouds(b), strict=True))
    np.testing.assert_array_equal(a.boxes.array, b.boxes.array)
    assert not np.array_equal(a.boxes.array, c.boxes.array)


def test_intensities_of_an_agent_are_rescaled_alike_and_stay_between_0_and_1(sample: Sample) -> None:
    constant, distinct = 0, set()
    for seed in range(40):
        new = rescaled(sample, 1.0, np.random.default_rng(seed))
        for before, after in zip(all_clouds(sample), all_clouds(new), strict=True):
            np.testing.assert_array_equal(after[:, :3], before[:, :3])
            assert after[:, 3].min() >= 0 and after[:, 3].max() <= 1
            # Brighter stays brighter.
            assert (np.diff(after[np.argsort(before[:, 3]), 3]) >= 0).all()
        for cloud, student in zip(new.clouds, new.corrupted, strict=True):
            np.testing.assert_array_equal(student, cloud[::2])
        values = {len(np.unique(cloud[:, 3])) for cloud in all_clouds(new)}
        constant += values == {1}
        distinct.add(round(float(np.median(new.clouds[0][:, 3])), 4))
        if values == {1}:
            (level,) = {float(cloud[0, 3]) for cloud in all_clouds(new)}
            assert 0 <= level <= 0.4
        else:
            # The points of all agents are as bright: other medians are of other scales.
            medians = [np.median(cloud[:, 3]) for cloud in new.clouds]
            assert np.ptp(medians) > 0.02 or min(medians) == 1
    assert 10 <= constant <= 30 and len(distinct) > 30


def test_a_share_of_the_samples_is_rescaled(sample: Sample) -> None:
    changed = sum(rescaled(sample, 0.3, np.random.default_rng(seed)) is not sample for seed in range(300))
    assert 60 <= changed <= 120
