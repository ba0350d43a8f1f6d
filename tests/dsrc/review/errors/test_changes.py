"""What a corruption or another method takes and gives, object by object."""

import numpy as np
import pytest

from dsrc.review.errors.changes import changes
from dsrc.review.errors.filters import ErrorFilter, Span
from tests.dsrc.review.errors.runs import draw_run


def found_objects(run, threshold, iou):
    rows = np.flatnonzero(run.found(threshold, iou))
    return {(int(run.table.position[run.truth_frame_of[row]]), int(run.table.object_id[row])) for row in rows}


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


def test_titles_say_what_took_and_what_gave() -> None:
    clean, fog = draw_run(0, skill=0.9), draw_run(0, kind="fog", skill=0.5)
    made = changes(clean, fog, 0.3, 0.5)
    assert {made.title(row) for row in range(len(made))} == {"fixed by fog 3", "broken by fog 3"}
    better = changes(draw_run(0, "AttFuse", "fog", 0.4), draw_run(0, "DSRC", "fog", 0.9), 0.3, 0.5)
    assert better.title(int(np.flatnonzero(better.fixed)[0])) == "fixed by DSRC" and better.before == "AttFuse"
    both = changes(draw_run(0, "AttFuse"), draw_run(0, "DSRC", "fog", 0.4), 0.3, 0.5)
    assert (both.before, both.after) == ("AttFuse in clean", "DSRC in fog 3")


def test_frames_are_ranked_by_what_was_taken() -> None:
    clean, fog = draw_run(1, skill=0.9), draw_run(1, kind="fog", skill=0.3)
    made = changes(clean, fog, 0.3, 0.5)
    rows, taken = made.worst_frames()
    assert sorted(rows.tolist()) == clean.table.position.tolist() and (np.diff(taken) <= 0).all() and taken[0] > 0
    for row, count in zip(rows, taken, strict=True):
        here = made.fixed[made.row == row]
        assert count == np.count_nonzero(~here) - np.count_nonzero(here)


def test_a_filter_chooses_the_objects() -> None:
    clean, fog = draw_run(1, skill=0.9), draw_run(1, kind="fog", skill=0.3)
    near = changes(clean, fog, 0.3, 0.5, ErrorFilter(distance_m=Span(0, 30)))
    everything = changes(clean, fog, 0.3, 0.5)
    assert 0 < len(near) == np.count_nonzero(everything.distance_m <= 30) < len(everything)
    assert len(changes(clean, clean, 0.3, 0.5)) == 0
