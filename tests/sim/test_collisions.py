"""Overlaps of boxes: compared with polygons, and with cases that are known by eye."""

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon

from sim.boxes import Boxes
from sim.collisions import collide, overlap, overlapping_pairs

number = st.floats(-6.0, 6.0)
turn = st.floats(-3.2, 3.2)


@settings(deadline=None, max_examples=200)
@given(number, number, turn, turn, st.floats(0.5, 9.0), st.floats(0.5, 3.0))
def test_footprints_overlap_where_polygons_do(
    x: float, y: float, first_yaw: float, second_yaw: float, length: float, width: float
) -> None:
    first = Boxes.from_array([[0.0, 0.0, 0.8, 4.0, 2.0, 1.6, first_yaw]]).bev_polygons()
    second = Boxes.from_array([[x, y, 0.8, length, width, 1.6, second_yaw]]).bev_polygons()
    a, b = Polygon(first[0]), Polygon(second[0])
    assume(a.intersection(b).area > 1e-6 or a.distance(b) > 1e-6)  # touching is a case of its own
    assert overlap(first, second).tolist() == overlap(second, first).tolist() == [a.intersection(b).area > 1e-6]


def test_footprints_are_compared_row_by_row_and_one_with_many() -> None:
    boxes = Boxes.from_array([[x, 0, 1, 4, 2, 2, 0.3] for x in (0.0, 3.0, 9.0)])
    shapes = boxes.bev_polygons()
    assert overlap(shapes[:1], shapes).tolist() == [True, True, False]
    assert overlap(shapes[:, None], shapes[None]).tolist() == [
        [True, True, False], [True, True, False], [False, False, True],
    ]  # fmt: skip


def test_a_turned_face_that_touches_and_a_box_without_area_overlap_nothing() -> None:
    for yaw in np.linspace(-3.0, 3.0, 25):
        ahead = 5000.0 + 4.0 * np.array([np.cos(yaw), np.sin(yaw)])
        boxes = Boxes.from_array(
            [[5000, 5000, 1, 4, 2, 2, yaw], [*ahead, 1, 4, 2, 2, yaw], [5000, 5000, 1, 0, 2, 2, 0]]
        )
        assert len(overlapping_pairs(boxes)) == 0
        assert overlapping_pairs(boxes, margin=-3.0).size == 0


def test_one_box_is_compared_with_many_and_only_those_at_its_height_are_hit() -> None:
    ego = Boxes.from_array([[0, 0, 0.75, 4, 2, 1.5, 0.0]])
    others = Boxes.from_array([[1, 1, z, 4, 2, 1.5, 0.3] for z in (-5.25, 0.9, 2.24, 2.25, 6.75)])
    assert collide(ego, others).tolist() == [False, True, True, False, False]
    assert collide(ego, Boxes.zeros()).shape == (0,)


def test_two_cars_parked_into_each_other_are_found_and_a_third_beside_them_is_not() -> None:
    boxes = Boxes.from_array(
        [[0, 0, 0.75, 4.5, 1.8, 1.5, 0.0], [4.4, 0, 0.75, 4.5, 1.8, 1.5, 0.0], [0, 1.9, 0.75, 4.5, 1.8, 1.5, 0.0]]
    )
    assert overlapping_pairs(boxes).tolist() == [[0, 1]]


def test_touching_faces_do_not_overlap_and_a_margin_makes_them() -> None:
    boxes = Boxes.from_array([[0, 0, 1, 4, 2, 2, 0.0], [4, 0, 1, 4, 2, 2, 0.0]])
    assert len(overlapping_pairs(boxes)) == 0
    assert len(overlapping_pairs(boxes, margin=0.01)) == 1


def test_a_car_under_a_bridge_does_not_hit_the_car_on_it() -> None:
    boxes = Boxes.from_array([[0, 0, 0.75, 4, 2, 1.5, 0.0], [0, 0, 6.75, 4, 2, 1.5, 0.3]])
    assert len(overlapping_pairs(boxes)) == 0


def test_circles_that_meet_while_rectangles_pass_are_apart() -> None:
    boxes = Boxes.from_array([[0, 0, 1, 4, 2, 2, np.pi / 4], [2.3, -1.2, 1, 4, 2, 2, np.pi / 4]])
    assert len(overlapping_pairs(boxes)) == 0


def test_pairs_match_polygon_intersection() -> None:
    rng = np.random.default_rng(0)
    rows = np.column_stack(
        [
            rng.uniform(-12, 12, (60, 2)),
            np.ones(60),
            rng.uniform(1, 8, (60, 2)),
            np.full(60, 2.0),
            rng.uniform(-np.pi, np.pi, 60),
        ]
    )
    boxes = Boxes.from_array(rows)
    shapes = [Polygon(p) for p in boxes.bev_polygons()]
    expected = [[i, j] for i in range(60) for j in range(i + 1, 60) if shapes[i].intersection(shapes[j]).area > 1e-9]
    assert 50 < len(expected)
    assert overlapping_pairs(boxes).tolist() == expected


def test_no_boxes_have_no_overlaps() -> None:
    assert overlapping_pairs(Boxes.zeros()).shape == (0, 2)
    assert overlapping_pairs(Boxes.from_array([[0, 0, 0, 4, 2, 1, 0]])).shape == (0, 2)
