import numpy as np
from shapely.geometry import Polygon

from dsrc.ops.iou import rotated_nms
from sim.boxes import Boxes


def random_boxes(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.column_stack(
        [rng.uniform(-12, 12, (n, 2)), np.zeros(n), rng.uniform(1, 6, (n, 3)), rng.uniform(-4, 4, n)]
    )


def brute_force(boxes: np.ndarray, scores: np.ndarray, threshold: float) -> list[int]:
    polygons = [Polygon(p) for p in Boxes.from_array(boxes).bev_polygons()]
    kept = []
    for row in np.argsort(-scores, kind="stable"):
        overlaps = (polygons[row].intersection(polygons[k]).area / polygons[row].union(polygons[k]).area for k in kept)
        if all(overlap <= threshold for overlap in overlaps):
            kept.append(row)
    return kept


def test_it_keeps_what_polygon_clipping_keeps() -> None:
    rng = np.random.default_rng(3)
    for threshold in (0.05, 0.15, 0.5):
        boxes, scores = random_boxes(rng, 60), rng.random(60)
        assert rotated_nms(boxes, scores, threshold).tolist() == brute_force(boxes, scores, threshold)


def test_kept_boxes_survive_a_second_time() -> None:
    rng = np.random.default_rng(4)
    boxes, scores = random_boxes(rng, 200), rng.random(200)
    kept = rotated_nms(boxes, scores, 0.15)
    assert rotated_nms(boxes[kept], scores[kept], 0.15).tolist() == list(range(len(kept)))


def test_of_equal_scores_the_first_row_wins() -> None:
    boxes = np.array([[0, 0, 0, 4, 2, 1.5, 0], [0.1, 0, 0, 4, 2, 1.5, 0]])
    assert rotated_nms(boxes, [0.5, 0.5], 0.15).tolist() == [0]


def test_only_the_best_are_looked_at() -> None:
    boxes = random_boxes(np.random.default_rng(5), 50) * [[100, 100, 1, 1, 1, 1, 1]]
    scores = np.linspace(0, 1, 50)
    assert rotated_nms(boxes, scores, 0.15, limit=7).tolist() == list(range(49, 42, -1))


def test_nothing_in_nothing_out() -> None:
    assert rotated_nms(np.zeros((0, 7)), np.zeros(0), 0.15).shape == (0,)
