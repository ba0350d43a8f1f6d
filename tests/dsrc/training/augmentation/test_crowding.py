"""Vehicles put a second time beside what stands: where the copies are, what they show and hide, and what stays."""

from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from dsrc.data.sample import Sample
from dsrc.ops.ground import LIDAR_M
from dsrc.training.augmentation.augment import augment
from dsrc.training.augmentation.crowding import crowded
from dsrc.training.recipes import Augmentation, debug, override
from sim.boxes import CLASSES, Boxes
from sim.collisions import overlapping_pairs
from sim.errors import SettingsError

SEEDS = range(6)
BEAM = np.radians(0.4)
SKIN_M = 0.1
FEWEST = 20
EGO = Boxes.from_array([[0.0, 0.0, 0.0, 5.0, 2.0, 1.6, 0.0]])
AS_IT_IS = Augmentation(flip=False, rotation_deg=0.0, scale=0.0, random_ego=False, dropout=0.0)


def standing(rows: list[list[float]]) -> NDArray[np.float64]:
    """Return boxes x, y, z, l, w, h, yaw of rows x, y, l, w, h, yaw on the ground."""
    x, y, length, width, height, yaw = np.array(rows, np.float64).reshape(-1, 6).T
    return np.stack([x, y, 0.5 * height - LIDAR_M, length, width, height, yaw], axis=1)


def cast(solid: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return (P, 4) points of a LiDAR at the origin: where its beams first meet a box or the ground within 70 m."""
    # Off the edges of `directions`, also after a turn of some degrees.
    azimuth, elevation = np.meshgrid(
        np.arange(-np.pi, np.pi, BEAM) + 0.5 * BEAM, np.radians(np.arange(-23.9, 6.0, 0.6))
    )
    flat = np.cos(elevation).ravel()
    way = np.stack([flat * np.cos(azimuth).ravel(), flat * np.sin(azimuth).ravel(), np.sin(elevation).ravel()], axis=1)
    with np.errstate(divide="ignore"):
        first = np.where(way[:, 2] < 0, -LIDAR_M / way[:, 2], np.inf)
    for x, y, z, length, width, height, yaw in solid:
        c, s = np.cos(yaw), np.sin(yaw)
        turned = way @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        middle, half = np.array([c * x + s * y, c * y - s * x, z]), 0.5 * np.array([length, width, height])
        ends = np.stack([(middle - half) / turned, (middle + half) / turned])
        near, far = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        first = np.where((near <= far) & (near > 0), np.minimum(first, near), first)
    points = (way * first[:, None])[first < 70.0]
    return np.column_stack([points, np.random.default_rng(0).random(len(points))]).astype(np.float32)


def seen(users: Boxes, others: NDArray[np.float64]) -> Sample:
    """Return the sample of an ego alone among road users, of which those with a point are known, and other things."""
    cloud = cast(np.concatenate([users.array, others]))
    known = users[users.contains(cloud[:, :3], margin=1e-4).any(axis=1)]
    return Sample("made", (0,), (cloud,), np.eye(4)[None], known, (known,))


@cache
def street(seed: int) -> Sample:
    """Return a sample of cars, two people, hedges and posts at random places, none upon another."""
    rng = np.random.default_rng(seed)
    car, person, hedge, post = (4.4, 1.8, 1.5), (0.6, 0.6, 1.8), (6.0, 0.8, 1.9), (0.1, 0.1, 1.2)
    rows: list[list[float]] = []
    for size in [car] * 10 + [person] * 2 + [hedge] * 12 + [post] * 30:
        for _ in range(50):
            place = [*(rng.uniform(4.0, 20.0) * _way(rng.uniform(-np.pi, np.pi))), *size, rng.uniform(-np.pi, np.pi)]
            if not len(overlapping_pairs(Boxes.from_array(np.concatenate([EGO.array, standing([*rows, place])])))):
                rows.append(place)
                break
    made = standing(rows)
    users = np.flatnonzero((made[:, 3] > 0.5) & (made[:, 3] < 5.0))
    label = np.array([CLASSES.index("car" if made[row, 3] > 1.0 else "pedestrian") for row in users])
    return seen(Boxes.from_array(made[users], label, 100 + 7 * users), np.delete(made, users, axis=0))


def _way(angle: float) -> NDArray[np.float64]:
    return np.array([np.cos(angle), np.sin(angle)])


@pytest.fixture(scope="module")
def pairs() -> list[tuple[Sample, Sample]]:
    """Samples and what becomes of them."""
    streets = map(street, SEEDS)
    return [(before, crowded(before, 1.0, np.random.default_rng(seed))) for seed, before in enumerate(streets)]


def copies(before: Sample, after: Sample) -> Boxes:
    return after.boxes[len(before.boxes) :]


def old_and_new(before: Sample, after: Sample) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the points of a sample that it had before, and those that were put there."""
    known = {point.tobytes() for point in before.clouds[0]}
    old = np.array([point.tobytes() in known for point in after.clouds[0]])
    return after.clouds[0][old], after.clouds[0][~old]


def on(boxes: Boxes, cloud: NDArray[np.float32], margin: float = 0.0) -> NDArray[np.bool_]:
    """Return (N, P) which points lie on boxes, without the ground below."""
    bottom = boxes.center[:, 2] - 0.5 * boxes.size[:, 2]
    return np.asarray(boxes.contains(cloud[:, :3], margin=margin) & (cloud[:, 2] > bottom[:, None] + SKIN_M))


def above_footprint(
    boxes: Boxes, cloud: NDArray[np.float32], low_m: float, high_m: float, margin: float = 0.0
) -> NDArray[np.bool_]:
    """Return (N, P) which points between two heights lie above the footprints of boxes."""
    height = cloud[:, 2] + LIDAR_M
    tall = replace(boxes, size=boxes.size * [1, 1, 0] + [0, 0, 100.0])
    return np.asarray(tall.contains(cloud[:, :3], margin=margin) & (height > low_m) & (height < high_m))


def directions(cloud: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return numbers of the beams, squares of 0.4 degrees, and ranges of points in the plane."""
    away = np.hypot(cloud[:, 0], cloud[:, 1]).astype(np.float64)
    azimuth, elevation = np.arctan2(cloud[:, 1], cloud[:, 0]), np.arctan2(cloud[:, 2], away)
    column, row = (azimuth + np.pi) // BEAM, (elevation + np.radians(40.0)) // BEAM
    return (1000 * column + row).astype(np.int64), away


def test_vehicles_are_put_beside_hedges_and_nobody_else_is(pairs: list[tuple[Sample, Sample]]) -> None:
    assert sum(len(copies(*pair)) for pair in pairs) > 10
    people = 0
    for before, after in pairs:
        counts = on(before.boxes, before.clouds[0]).sum(axis=1)
        people += int((before.boxes.is_vulnerable & (counts >= FEWEST)).sum())
        assert copies(before, after).is_vehicle.all()
    assert people > 2


def test_at_0_a_sample_is_the_same_object() -> None:
    before = street(0)
    assert crowded(before, 0.0, np.random.default_rng(0)) is before


def test_where_nothing_is_tall_a_sample_is_the_same_object() -> None:
    before = seen(Boxes.from_array(standing([[0.0, -8.0, 4.4, 1.8, 0.7, 0.0]])), standing([]))
    assert on(before.boxes, before.clouds[0]).sum() > 100
    assert crowded(before, 1.0, np.random.default_rng(0)) is before


def test_a_car_goes_to_the_one_wall_and_takes_its_side_along() -> None:
    before = seen(
        Boxes.from_array(standing([[0.0, -8.0, 4.4, 1.8, 1.5, 0.0]])), standing([[0.0, 10.3, 12.0, 0.3, 2.5, 0.0]])
    )
    after = crowded(before, 1.0, np.random.default_rng(0))
    (copy,) = copies(before, after).array
    # Turns are multiples of four degrees.
    np.testing.assert_allclose(np.hypot(copy[0], copy[1]), 8.0, atol=1e-5)
    assert abs(copy[0]) < 4.0 and copy[1] > 6.5
    side = on(copies(before, after), after.clouds[0], SKIN_M)[0]
    assert side.sum() == on(before.boxes, before.clouds[0], SKIN_M).sum()
    turn = copy[6] - before.boxes.yaw[0]
    local = after.clouds[0][side, :2] @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    # The near side of the car: 7.1 m away.
    assert np.median(local[:, 1]) == pytest.approx(-7.1, abs=0.01)


def test_a_copy_has_the_range_size_and_aspect_of_a_vehicle_and_at_most_its_points(
    pairs: list[tuple[Sample, Sample]],
) -> None:
    for before, after in pairs:
        _, new = old_and_new(before, after)
        counts = on(before.boxes, before.clouds[0], SKIN_M).sum(axis=1)
        for copy, own in zip(copies(before, after).array, on(copies(before, after), new, SKIN_M + 1e-4), strict=True):
            of = [row for row in np.flatnonzero(before.boxes.is_vehicle) if _alike(before.boxes.array[row], copy)]
            assert len(of) == 1
            assert FEWEST <= own.sum() <= counts[of[0]]


def _alike(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether two boxes are the same but for a turn about the sensor."""
    turn = np.arctan2(other[1], other[0]) - np.arctan2(one[1], one[0])
    same = np.allclose(np.hypot(one[0], one[1]), np.hypot(other[0], other[1]), atol=1e-4)
    aspect = abs(np.sin(0.5 * (other[6] - one[6] - turn))) < 1e-4
    return bool(same and aspect and np.allclose(one[2:6], other[2:6], atol=1e-4))


def test_a_copy_overlaps_nobody_and_its_footprint_was_free(pairs: list[tuple[Sample, Sample]]) -> None:
    for before, after in pairs:
        new = copies(before, after)
        everyone = Boxes.from_array(np.concatenate([EGO.array, after.boxes.array]))
        flat = replace(everyone, center=everyone.center * [1, 1, 0])
        assert not len(overlapping_pairs(flat))
        assert not above_footprint(new, before.clouds[0], 0.36, 2.99).any()


def test_no_copy_stands_in_the_ego() -> None:
    # A wall ahead: a copy of what stands 3.4 m beside the sensor would reach it in the ego's bonnet.
    wall = standing([[5.6, 0.0, 0.3, 9.0, 2.5, 0.0]])
    for away, expected in ((3.4, 0), (4.4, 1)):
        before = seen(Boxes.from_array(standing([[0.0, -away, 4.2, 1.6, 1.5, 0.0]])), wall)
        after = crowded(before, 1.0, np.random.default_rng(0))
        new = copies(before, after)
        assert (new.center[:, 0] > 2.0).sum() == expected
        assert not len(overlapping_pairs(Boxes.from_array(np.concatenate([EGO.array, new.array]))))


def test_nothing_but_its_own_points_stands_in_a_copy(pairs: list[tuple[Sample, Sample]]) -> None:
    for before, after in pairs:
        old, new = old_and_new(before, after)
        assert not above_footprint(copies(before, after), old, 0.36, 2.99).any()
        assert on(copies(before, after), new, SKIN_M + 1e-4).sum(axis=0).min(initial=1) == 1


def test_something_tall_stands_within_reach_of_a_copy(pairs: list[tuple[Sample, Sample]]) -> None:
    for before, after in pairs:
        beside = above_footprint(copies(before, after), before.clouds[0], 0.8, 3.0, margin=1.7)
        assert (beside.sum(axis=1) >= 12).all()


def test_no_point_lies_behind_a_copy_in_its_beams(pairs: list[tuple[Sample, Sample]]) -> None:
    for before, after in pairs:
        old, new = old_and_new(before, after)
        (beams, away), (old_beams, old_away) = directions(new), directions(old)
        nearest = {int(beam): away[beams == beam].min() for beam in np.unique(beams)}
        behind = [far > nearest.get(int(beam), np.inf) + 1e-3 for beam, far in zip(old_beams, old_away, strict=True)]
        assert not any(behind)
        # Something was there.
        assert len(old) <= len(before.clouds[0]) - 0.3 * len(new)


def test_no_point_of_a_copy_lies_behind_what_stands_in_its_beam(pairs: list[tuple[Sample, Sample]]) -> None:
    for before, after in pairs:
        old, new = old_and_new(before, after)
        old = old[old[:, 2] + LIDAR_M > 0.36]
        (beams, away), (new_beams, new_away) = directions(old), directions(new)
        nearest = {int(beam): away[beams == beam].min() for beam in np.unique(beams)}
        assert all(far <= nearest.get(int(beam), np.inf) + 0.51 for beam, far in zip(new_beams, new_away, strict=True))


def test_nobody_known_is_left_without_points(pairs: list[tuple[Sample, Sample]]) -> None:
    fewer = 0
    for before, after in pairs:
        was = on(before.boxes, before.clouds[0], SKIN_M).sum(axis=1)
        left = on(after.boxes, after.clouds[0], SKIN_M).sum(axis=1)
        assert (left[: len(was)] >= np.minimum(was, FEWEST)).all()
        assert (left[len(was) :] >= FEWEST).all()
        fewer += int((left[: len(was)] < was).sum())
    assert fewer > 0


def test_ids_of_copies_are_new_and_both_kinds_of_boxes_agree(pairs: list[tuple[Sample, Sample]]) -> None:
    for before, after in pairs:
        ids = after.boxes.object_id
        assert len(np.unique(ids)) == len(ids)
        np.testing.assert_array_equal(ids[: len(before.boxes)], before.boxes.object_id)
        np.testing.assert_array_equal(after.boxes.array[: len(before.boxes)], before.boxes.array)
        (own,) = after.agent_boxes
        np.testing.assert_array_equal(own.object_id, ids)
        np.testing.assert_array_equal(own.array, after.boxes.array)
        np.testing.assert_array_equal(own.label, after.boxes.label)


def test_an_agent_that_has_not_seen_all_gets_the_copies_too() -> None:
    before = street(0)
    some = replace(before, agent_boxes=(before.boxes[1:],))
    after = crowded(some, 1.0, np.random.default_rng(0))
    new = copies(before, after)
    assert len(new)
    np.testing.assert_array_equal(after.agent_boxes[0].object_id, [*before.boxes.object_id[1:], *new.object_id])


def test_one_seed_gives_one_result_and_the_sample_stays(pairs: list[tuple[Sample, Sample]]) -> None:
    before, after = pairs[0]
    again = street.__wrapped__(0)
    np.testing.assert_array_equal(before.clouds[0], again.clouds[0])
    same, other = (crowded(again, 1.0, np.random.default_rng(seed)) for seed in (0, 1))
    np.testing.assert_array_equal(same.clouds[0], after.clouds[0])
    np.testing.assert_array_equal(same.boxes.array, after.boxes.array)
    few = [len(crowded(again, 0.3, np.random.default_rng(seed)).boxes) for seed in range(8)]
    assert len(set(few)) > 1 and np.mean(few) < len(after.boxes)
    assert len(other.boxes) > len(before.boxes)


def of_two(before: Sample) -> Sample:
    """Return a sample of two agents at one place."""
    return replace(
        before,
        agent_ids=(0, 1),
        clouds=before.clouds * 2,
        ego_from_agent=np.stack([np.eye(4)] * 2),
        agent_boxes=before.agent_boxes * 2,
    )


def test_samples_of_several_agents_and_of_corrupted_sensors_stay() -> None:
    before = street(0)
    for other in (of_two(before), replace(before, corrupted=before.clouds)):
        assert crowded(other, 1.0, np.random.default_rng(0)) is other


@pytest.mark.parametrize("chance", [{"alone": 1.0}, {"alone": 0.0}])
def test_an_ego_that_is_drawn_alone_gets_copies_and_a_team_none(chance: dict[str, float]) -> None:
    grid = debug().model.grid
    plain, crowding = (msgspec.structs.replace(AS_IT_IS, crowding=share, **chance) for share in (0.0, 1.0))
    more = 0
    for seed in SEEDS:
        before = of_two(street(seed))
        without, after = (augment(before, grid, choice, np.random.default_rng(seed)) for choice in (plain, crowding))
        first = len(without.boxes)
        assert len(after.clouds) == len(without.clouds) == (1 if chance["alone"] else 2)
        np.testing.assert_array_equal(after.boxes.array[:first], without.boxes.array)
        assert len(after.other_clouds) == len(without.other_clouds)
        more += len(after.boxes) - first
    assert more > 3 if chance["alone"] else more == 0


def test_crowding_moves_no_other_change() -> None:
    grid = debug().model.grid
    plain, crowding = (Augmentation(alone=1.0, crowding=share, thinning=0.5) for share in (0.0, 1.0))
    for seed in SEEDS:
        without, after = (
            augment(street(seed), grid, choice, np.random.default_rng(seed)) for choice in (plain, crowding)
        )
        np.testing.assert_array_equal(after.boxes.array[: len(without.boxes)], without.boxes.array)
        assert len(after.corrupted) == len(without.corrupted)


def test_heights_of_the_sensor_are_refused() -> None:
    recipe = override(debug(), ["augmentation.crowding=0.3", "model.height=ground"])
    assert recipe.augmentation.crowding == 0.3
    with pytest.raises(SettingsError, match=r"or model\.height=ground, found 0\.3 with model\.height=sensor"):
        override(debug(), ["augmentation.crowding=0.3"])
