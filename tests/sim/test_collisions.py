"""Overlaps of boxes: compared with polygons, and with cases that are known by eye."""

import numpy as np
from shapely.geometry import Polygon

from sim.boxes import Boxes
from sim.collisions import overlapping_pairs


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
