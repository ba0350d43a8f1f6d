"""What a corruption or another method takes and gives, object by object."""

from collections.abc import Iterator

import numpy as np
import pytest

from dsrc.review.errors.changes import changes
from dsrc.review.errors.filters import ErrorFilter, Span
from dsrc.review.errors.judged import JudgedRun
from tests.dsrc.review.errors.runs import draw_run


def objects_of(run: JudgedRun) -> Iterator[tuple[int, int]]:
    return zip(run.table.position[run.truth_frame_of].tolist(), run.table.object_id.tolist(), strict=True)


def found_objects(run: JudgedRun, threshold: float, iou: float) -> set[tuple[int, int]]:
    return {key for key, found in zip(objects_of(run), run.found(threshold, iou), strict=True) if found}


@pytest.mark.parametrize("seed", range(4))
def test_changes_are_the_differences_of_the_found_objects(seed: int) -> None:
    clean, fog = draw_run(seed, skill=0.9), draw_run(seed, kind="fog", skill=0.5)
    made = changes(clean, fog, 0.3, 0.5)
    before, after = found_objects(clean, 0.3, 0.5), found_objects(fog, 0.3, 0.5)
    keys = list(zip(made.row.tolist(), made.object_id.tolist(), strict=True))
    assert {key for key, fixed in zip(keys, made.fixed, strict=True) if fixed} == after - before
    assert {key for key, fixed in zip(keys, made.fixed, strict=True) if not fixed} == before - after
    assert len(set(keys)) == len(made) and (np.diff(made.row) >= 0).all()
    back = changes(fog, clean, 0.3, 0.5)
    assert len(back) == len(made) and back.fixed.sum() == (~made.fixed).sum()


def test_a_filter_chooses_the_objects() -> None:
    clean, fog = draw_run(1, skill=0.9), draw_run(1, kind="fog", skill=0.3)
    near = changes(clean, fog, 0.3, 0.5, ErrorFilter(distance_m=Span(0, 30)))
    everything = changes(clean, fog, 0.3, 0.5)
    boxes = {key: m for key, m in zip(objects_of(fog), fog.truth_distance_m.tolist(), strict=True)}
    keys = zip(everything.row.tolist(), everything.object_id.tolist(), strict=True)
    assert 0 < len(near) == sum(boxes[key] <= 30 for key in keys) < len(everything)
    assert len(changes(clean, clean, 0.3, 0.5)) == 0
