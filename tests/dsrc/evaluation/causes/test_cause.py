"""Causes of errors on a made street: an ego and a helper, a truck between the ego and a car, a car in the open."""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from dsrc.evaluation.causes.cause import FALSE, MISSED, Circumstances, ErrorCause, frame_causes
from dsrc.evaluation.detection_table import DetectionTable, one_frame
from dsrc.messages.attacks import Lie
from dsrc.ops.detections import Detections
from sensors.frame import AgentFrame, Frame
from sensors.sweep import KEPT, SCATTERED, make_sweep
from sim.boxes import Boxes
from sim.errors import DataError
from sim.geometry import pose_matrix

EGO, HELPER, TRUCK, HIDDEN, OPEN, WALKER = 1000, 1001, 1002, 1003, 1004, 1005
LIDAR_M = 1.9
SHIFT = np.array([500.0, -200.0, 20.0])
"""Place of the street in the world: nothing may depend on it."""


def boxes() -> Boxes:
    array = [
        [0.0, 0.0, 0.8, 4.5, 1.9, 1.6, 0.0],
        [40.0, 6.0, 0.8, 4.5, 1.9, 1.6, np.pi],
        [15.0, 0.0, 1.7, 8.0, 2.5, 3.4, 0.0],
        [26.0, 0.0, 0.8, 4.5, 1.9, 1.6, 0.0],
        [12.0, 9.0, 0.8, 4.5, 1.9, 1.6, 0.0],
        [-8.0, -6.0, 0.9, 0.6, 0.6, 1.8, 0.0],
    ]
    made = Boxes.from_array(array, [0, 0, 2, 0, 0, 6], [EGO, HELPER, TRUCK, HIDDEN, OPEN, WALKER])
    return made.transform(pose_matrix(SHIFT))


def frame(points: dict[int, tuple[int, int]], velocity: tuple[float, float] = (0.0, 0.0)) -> Frame:
    """Frame in which the ego and the helper have so many points on objects."""
    truth, agents = boxes(), []
    for k, agent in enumerate((EGO, HELPER)):
        body = np.asarray(pose_matrix(truth.center[k] - [0.0, 0.0, 0.8], truth.yaw[k]), np.float64)
        lidar = body @ pose_matrix([0.0, 0.0, LIDAR_M])
        local, ids = [], []
        for object_id, counts in points.items():
            centre = truth.center[truth.object_id == object_id][0]
            local += [np.linalg.inv(lidar)[:3, :3] @ (centre - lidar[:3, 3])] * counts[k]
            ids += [object_id] * counts[k]
        sweep = make_sweep(np.array(local, np.float64).reshape(-1, 3), lidar, 0.0, object_id=ids)
        agents.append(AgentFrame(agent, "vehicle", body, 5.0, sweep))
    on = np.array([[points.get(i, (0, 0))[k] for i in truth.object_id.tolist()] for k in (0, 1)], np.int32)
    return Frame(7, 0.7, tuple(agents), truth, np.tile(velocity, (len(truth), 1)), on)


OFTEN = {TRUCK: (90, 40), HIDDEN: (0, 61), OPEN: (70, 30), HELPER: (30, 0)}


def table(of: Frame, found: list[tuple[list[float], float]], objects: tuple[int, ...] = (TRUCK, HIDDEN, OPEN)) -> Any:
    """Table of the judged objects and some boxes, given where the ego's LiDAR is the middle of the world's ground."""
    back = np.linalg.inv(of.agent(EGO).sweep.world_from_lidar)
    truth = of.truth.transform(back)
    rows = np.isin(truth.object_id, objects)
    array = np.array([box for box, _ in found], np.float64).reshape(-1, 7)
    array[:, 2] -= LIDAR_M
    detections = Detections(Boxes.from_array(array), np.array([score for _, score in found], np.float32))
    ids = [int(np.flatnonzero(of.truth.object_id == i)[0]) for i in truth.object_id[rows]]
    clean = np.stack([of.points_on[0, ids], of.points_on[:, ids].sum(axis=0)], axis=1)
    return one_frame(0, of.index, EGO, detections, truth[rows], np.concatenate([clean, clean], axis=1))


TRUCK_BOX = ([15.0, 0.0, 1.7, 8.0, 2.5, 3.4, 0.0], 0.9)
HIDDEN_BOX = ([26.0, 0.0, 0.8, 4.5, 1.9, 1.6, 0.0], 0.8)
OPEN_BOX = ([12.0, 9.0, 0.8, 4.5, 1.9, 1.6, 0.0], 0.85)


def beside(box: tuple[list[float], float], x: float = 0.0, y: float = 0.0, yaw: float = 0.0, score: float = 0.7) -> Any:
    array = list(box[0])
    array[0], array[1], array[6] = array[0] + x, array[1] + y, array[6] + yaw
    return array, score


def causes(of: Frame, found: list[Any], known: Circumstances | None = None, **more: Any) -> list[ErrorCause]:
    return frame_causes(table(of, found, **more), of, 0.3, 0.5, known or Circumstances())


def the_one(of: Frame, found: list[Any], known: Circumstances | None = None, **more: Any) -> ErrorCause:
    (cause,) = causes(of, found, known, **more)
    return cause


def test_what_is_found_has_no_cause() -> None:
    assert causes(frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, OPEN_BOX]) == []


def test_a_box_just_below_the_threshold_says_by_how_much_and_what_hid_the_object() -> None:
    cause = the_one(frame(OFTEN), [TRUCK_BOX, OPEN_BOX, (HIDDEN_BOX[0], 0.28)])
    assert (cause.error, cause.kind, cause.object_id, cause.rank) == ("missed", "below threshold", HIDDEN, 2)
    assert cause.sentence == "score 0.28 is below 0.3 by 0.02; behind the truck 1002 for the ego"
    assert (cause.score, cause.iou) == (0.28, 1.0) and (cause.points, cause.points_left) == (61, 61)
    assert (cause.hidden_from, cause.hidden_by) == ((EGO,), (TRUCK,))


def test_a_score_and_an_overlap_have_the_digits_that_tell_them_from_the_threshold() -> None:
    cause = the_one(frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, (OPEN_BOX[0], 0.2996)])
    assert cause.sentence.startswith("score 0.2996 is below 0.3 by 0.0004")
    cause = the_one(frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, (OPEN_BOX[0], 0.298)])
    assert cause.sentence.startswith("score 0.298 is below 0.3 by 0.002")
    # A box that is moved by a third of its length has an IoU of 0.5.
    for x, overlap in ((1.502, "0.4995"), (1.51, "0.498")):
        for one in causes(frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, beside(OPEN_BOX, x=x)]):
            assert f"IoU {overlap} is below 0.5" in one.sentence


def test_few_points_are_counted_against_the_clean_frame() -> None:
    of = frame(OFTEN)
    known = table(of, [TRUCK_BOX, HIDDEN_BOX])
    known = replace(known, points=np.array([[90, 130, 90, 130], [0, 61, 0, 61], [70, 100, 3, 9]], np.int32))
    (cause,) = frame_causes(known, of, 0.3, 0.5, Circumstances(condition="snow 3"))
    assert (cause.kind, cause.sentence) == ("few points", "9 of 100 points left in snow 3")
    assert (cause.object_id, cause.points, cause.points_left) == (OPEN, 100, 9)
    alone = frame({**OFTEN, OPEN: (3, 0)})
    cause = the_one(alone, [TRUCK_BOX, HIDDEN_BOX])
    assert cause.kind == "few points" and cause.sentence.startswith("3 points on it; out of reach")


@pytest.mark.parametrize(("points", "kind"), [(20, "few points"), (21, "no box")])
def test_twenty_points_are_few_whether_or_not_a_corruption_left_them(points: int, kind: str) -> None:
    cause = the_one(frame({**OFTEN, OPEN: (points, 0)}), [TRUCK_BOX, HIDDEN_BOX])
    assert (cause.kind, cause.points, cause.points_left) == (kind, points, points)


def test_a_corrupted_frame_tells_the_points_that_are_left() -> None:
    of = frame(OFTEN)
    sweep = of.agents[0].sweep
    thinned = of.with_sweeps([sweep[(sweep.object_id != OPEN) | (np.arange(len(sweep)) % 40 == 0)], of.agents[1].sweep])
    left = int(np.count_nonzero(thinned.agents[0].sweep.object_id == OPEN))
    cause = the_one(of, [TRUCK_BOX, HIDDEN_BOX, (OPEN_BOX[0], 0.2)], Circumstances("fog 5", thinned))
    assert cause.points_left == left + 30 < 40
    assert cause.sentence == f"score 0.20 is below 0.3 by 0.10; {left + 30} of 100 points left in fog 5"


def test_an_ego_alone_misses_what_a_truck_hides_from_it() -> None:
    known = Circumstances(team=(EGO,))
    cause = the_one(frame(OFTEN), [TRUCK_BOX, OPEN_BOX], known)
    assert (cause.kind, cause.hidden_from, cause.hidden_by) == ("hidden", (EGO,), (TRUCK,))
    assert cause.sentence == "no agent that takes part has a point on it; behind the truck 1002 for the ego"


def test_what_no_road_user_hides_is_out_of_reach_or_behind_something_else() -> None:
    cause = the_one(frame({**OFTEN, OPEN: (0, 0)}), [TRUCK_BOX, HIDDEN_BOX])
    assert cause.kind == "hidden" and cause.hidden_by == (None, None) and cause.hidden_from == (EGO, HELPER)
    assert cause.sentence.endswith("out of reach, or behind what is no road user, for every agent")


def test_a_lost_message_of_the_only_helper_that_saw_it() -> None:
    cause = the_one(frame(OFTEN), [TRUCK_BOX, OPEN_BOX], Circumstances(ages={HELPER: None}))
    assert (cause.kind, cause.helper, cause.points_left) == ("message missing", HELPER, 0)
    assert cause.sentence.startswith(
        "only helper 1001 has points on it, 61, and its message was lost; 0 of 61 points left"
    )


def test_a_late_message_moves_what_only_the_helper_saw() -> None:
    of, known = frame(OFTEN, velocity=(10.0, 0.0)), Circumstances(ages={HELPER: 0.24})
    cause = the_one(of, [TRUCK_BOX, OPEN_BOX], known)
    assert (cause.kind, cause.helper) == ("message late", HELPER)
    assert cause.sentence.startswith("no box; the message of helper 1001, 240 ms old, moves its points by 2.4 m")
    missed, false = causes(of, [TRUCK_BOX, OPEN_BOX, beside(HIDDEN_BOX, x=-2.4)], known)
    assert (missed.kind, false.kind, false.object_id) == ("message late", "message late", HIDDEN)
    standing = causes(frame(OFTEN), [TRUCK_BOX, OPEN_BOX, beside(HIDDEN_BOX, x=-2.4)], known)
    assert [one.kind for one in standing] == ["badly placed", "badly placed"], "what stands still is where it was"


def test_a_pose_error_of_the_helper_moves_the_box_by_as_much() -> None:
    of = frame(OFTEN)
    helper = of.agents[1].sweep
    off = np.asarray(pose_matrix([0.0, 1.5, 0.0]), np.float64)
    told = of.with_sweeps([of.agents[0].sweep, replace(helper, world_from_lidar=off @ helper.world_from_lidar)])
    missed, false = causes(of, [TRUCK_BOX, OPEN_BOX, beside(HIDDEN_BOX, y=1.3)], Circumstances("pose error 3", told))
    assert (missed.kind, missed.helper, false.kind, false.helper) == ("pose error", HELPER, "pose error", HELPER)
    assert "the pose error of helper 1001 moves its points by 1.5 m: IoU 0.19 is below 0.5" in missed.sentence
    other = causes(of, [TRUCK_BOX, OPEN_BOX, beside(HIDDEN_BOX, y=-1.3)], Circumstances("pose error 3", told))
    assert [one.kind for one in other] == ["badly placed", "badly placed"], "it is off to the other side"


def test_a_turned_box_and_one_beside_the_object() -> None:
    missed, false = causes(frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, beside(OPEN_BOX, yaw=np.pi / 3)])
    assert (missed.kind, false.kind, missed.rank) == ("wrong heading", "wrong heading", 2)
    assert "turned by 60°" in missed.sentence and false.sentence.startswith("score 0.70: meant for the car 1004")
    missed, false = causes(frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, beside(OPEN_BOX, x=2.0, y=0.2)])
    assert (missed.kind, false.kind) == ("badly placed", "badly placed")
    assert "its box is 2.0 m off" in missed.sentence and missed.iou == false.iou and 0.1 < (missed.iou or 0.0) < 0.5
    opposite = causes(frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, beside(OPEN_BOX, yaw=np.pi)])
    assert opposite == [], "a box that faces backwards is the same box"


def test_a_box_beside_the_object_of_too_low_a_score_is_named_where_points_are_enough() -> None:
    weak = beside(OPEN_BOX, x=2.0, score=0.26)
    cause = the_one(frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, weak])
    assert (cause.kind, cause.rank, cause.score) == ("badly placed", 2, 0.26)
    assert cause.sentence.endswith("IoU 0.38 is below 0.5, and its score 0.26 below 0.3")
    assert the_one(frame({**OFTEN, OPEN: (9, 0)}), [TRUCK_BOX, HIDDEN_BOX, weak]).kind == "few points"
    both = causes(frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, beside(OPEN_BOX, x=3.0), weak])
    assert [one.rank for one in both] == [2, 2], "a box that counts comes before a better one that does not"


def test_points_enough_and_no_box() -> None:
    cause = the_one(frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX])
    assert (cause.kind, cause.sentence) == ("no box", "no box overlaps it, with 100 points on it")


def test_an_object_out_of_the_detectors_range() -> None:
    known = Circumstances(range_m=(-20.0, -20.0, -3.0, 20.0, 20.0, 1.0))
    cause = the_one(frame(OFTEN), [TRUCK_BOX, OPEN_BOX], known)
    assert (cause.kind, cause.object_id) == ("out of range", HIDDEN)
    assert cause.sentence == "at 26, 0 m it is outside the range of the detector"


def test_false_boxes_on_the_ego_twice_on_an_object_and_on_what_is_not_judged() -> None:
    right = [TRUCK_BOX, HIDDEN_BOX, OPEN_BOX]
    own = the_one(frame(OFTEN), [*right, ([0.5, 0.0, 0.8, 4.0, 1.8, 1.5, 0.0], 0.6)])
    assert (own.error, own.kind, own.object_id, own.rank) == ("false", "own body", EGO, 3)
    assert own.sentence == "score 0.60: it lies on the ego itself, 0.5 m from its LiDAR"
    twice = the_one(frame(OFTEN), [*right, beside(OPEN_BOX, x=0.4)])
    assert (twice.kind, twice.object_id) == ("doubled box", OPEN)
    assert "the car 1004 has a box of score 0.85 already" in twice.sentence
    walker = the_one(frame({**OFTEN, WALKER: (12, 0)}), [*right, ([-8.0, -6.0, 0.9, 0.8, 0.8, 1.8, 0.0], 0.5)])
    assert (walker.kind, walker.object_id) == ("not evaluated", WALKER)
    assert "12 points of the agents that take part" in walker.sentence


def test_false_boxes_of_snow_and_of_nothing() -> None:
    of, right = frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, OPEN_BOX]
    ghost = ([-15.0, 5.0, 0.8, 4.0, 1.8, 1.6, 0.0], 0.5)
    nothing = the_one(of, [*right, ghost])
    assert nothing.kind == "of nothing" and "no road user is there; 0 points are over it" in nothing.sentence
    lidar = of.agents[0].sweep.world_from_lidar
    flakes = np.tile([-15.0, 5.0, 0.8 - LIDAR_M], (6, 1))
    fate = np.array([SCATTERED] * 4 + [KEPT] * 2, np.uint8)
    snowed = of.with_sweeps([make_sweep(flakes, lidar, 0.7, fate=fate), of.agents[1].sweep])
    made = [one for one in causes(of, [*right, ghost], Circumstances("snow 5", snowed)) if one.error == "false"]
    assert [one.kind for one in made] == ["made by the corruption"]
    assert made[0].sentence == "score 0.50: 4 of the 6 points over it were made by snow 5"


def test_a_ghost_is_told_wrongly_by_the_helper_who_lies_and_by_nobody_who_does_not() -> None:
    of, right = frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, OPEN_BOX]
    ghost = ([-15.0, 5.0, 0.8, 4.0, 1.8, 1.6, 0.0], 0.5)
    there = Boxes.from_array([[-15.2, 5.1, 0.8, 4.5, 1.9, 1.5, 0.0]]).transform(pose_matrix(SHIFT))
    lie = Lie(there, (), False)
    found = the_one(of, [*right, ghost], Circumstances(lies={HELPER: lie}))
    assert (found.kind, found.helper) == ("told wrongly", HELPER)
    assert found.sentence == f"score 0.50: told wrongly by helper {HELPER}, 16 m away"
    elsewhere = replace(lie, ghosts=there.transform(pose_matrix([0.0, 6.0, 0.0])))
    assert the_one(of, [*right, ghost], Circumstances(lies={HELPER: elsewhere})).kind == "of nothing"
    doubled = the_one(of, [*right, beside(OPEN_BOX, 0.4, score=0.6)], Circumstances(lies={HELPER: lie}))
    assert doubled.kind == "doubled box", "what a liar tells elsewhere made no box here"


def test_an_object_that_a_liar_left_out_is_missed_for_that_unless_others_see_enough_of_it() -> None:
    of, nobody = frame(OFTEN), boxes()[:0]
    lied = Circumstances(lies={HELPER: Lie(nobody, (HIDDEN, OPEN), False)})
    missed = {one.object_id: one for one in causes(of, [TRUCK_BOX], lied)}
    assert (missed[HIDDEN].kind, missed[HIDDEN].helper) == ("left out", HELPER)
    assert missed[HIDDEN].sentence.startswith(f"left out by helper {HELPER}, who has 61 points on it")
    assert missed[OPEN].kind == "no box", "the ego has 70 points on it"


def test_flakes_all_over_a_box_made_it_though_a_pole_in_it_has_more_points() -> None:
    of, right = frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, OPEN_BOX]
    ghost, helper = ([-15.0, 5.0, 0.8, 4.0, 1.8, 1.6, 0.0], 0.5), of.agents[1].sweep
    flakes = np.array([[-15.0 + x, 5.0 + y, -1.0] for x in np.arange(-1.8, 1.9, 0.4) for y in (-0.6, -0.2, 0.2, 0.6)])
    for count, kind in ((40, "made by the corruption"), (8, "of nothing")):
        points = np.concatenate([flakes[:count], np.tile([-13.2, 5.1, -1.0], (500, 1))])
        if count == 8:
            points[8:, :2] += np.random.default_rng(1).uniform([-3.0, -0.8], [0.0, 0.6], (500, 2))
        fate = np.repeat(np.array([SCATTERED, KEPT], np.uint8), [count, 500])
        snowed = of.with_sweeps([make_sweep(points, of.agents[0].sweep.world_from_lidar, 0.7, fate=fate), helper])
        cause = the_one(of, [*right, ghost], Circumstances("snow 5", snowed))
        assert cause.kind == kind
        if kind == "made by the corruption":
            assert cause.sentence == (
                "score 0.50: 40 of the 540 points over it were made by snow 5, which alone fill 98 % of their area"
            )


def test_an_object_is_amid_flakes_where_they_share_half_of_the_cells_of_its_points() -> None:
    of, ego = frame({**OFTEN, OPEN: (0, 0)}), frame(OFTEN).agents[0].sweep
    own = np.array([[12.0 + x, 9.0, 0.8 - LIDAR_M] for x in (-1.8, -1.0, -0.2, 0.6)] * 10)
    for cells, kind in ((2, "amid made points"), (1, "no box")):
        points = np.concatenate([own, own[:cells] + np.array([0.0, 0.0, 2.0])])
        fate = np.repeat(np.array([KEPT, SCATTERED], np.uint8), [len(own), cells])
        ids = [OPEN] * len(own) + [-2] * cells
        sweep = make_sweep(points, ego.world_from_lidar, 0.7, object_id=ids)
        seen = replace(
            of.with_sweeps([sweep, of.agents[1].sweep]), points_on=of.points_on + 40 * (boxes().object_id == OPEN)
        )
        snowed = seen.with_sweeps(
            [make_sweep(points, ego.world_from_lidar, 0.7, object_id=ids, fate=fate), of.agents[1].sweep]
        )
        cause = the_one(seen, [TRUCK_BOX, HIDDEN_BOX], Circumstances("snow 5", snowed))
        assert (cause.kind, cause.object_id) == (kind, OPEN)
        if kind == "amid made points":
            assert cause.sentence == "no box; 2 points made by snow 5 lie over it, in 50 % of the cells with its own"


def test_echoes_above_a_low_box_made_it_as_columns_are_what_a_detector_sees() -> None:
    of, right = frame(OFTEN), [TRUCK_BOX, HIDDEN_BOX, OPEN_BOX]
    ghost, ego, helper = ([-15.0, 5.0, 0.8, 4.0, 1.8, 1.6, 0.0], 0.5), *(agent.sweep for agent in of.agents)
    for height, kind in ((2.5, "made by the corruption"), (5.0, "of nothing")):
        echoes = np.tile([-15.0, 5.0, height - LIDAR_M], (6, 1))
        fogged = make_sweep(echoes, ego.world_from_lidar, 0.7, fate=np.full(6, SCATTERED, np.uint8))
        known = Circumstances("fog 3", of.with_sweeps([fogged, helper]))
        false = [one for one in causes(of, [*right, ghost], known) if one.error == "false"]
        assert [one.kind for one in false] == [kind]


def test_a_box_made_of_the_points_of_a_road_user_is_of_it_though_they_hardly_overlap() -> None:
    of, side = frame(OFTEN), ([15.0, 2.05, 1.0, 4.5, 1.7, 1.6, 0.0], 0.5)
    points = np.column_stack([np.linspace(13.0, 17.0, 60), np.full(60, 1.24), np.full(60, 1.0 - LIDAR_M)])
    ego = of.agents[0].sweep
    seen = of.with_sweeps([make_sweep(points, ego.world_from_lidar, 0.0, object_id=[TRUCK] * 60), of.agents[1].sweep])
    twice = the_one(seen, [TRUCK_BOX, HIDDEN_BOX, OPEN_BOX, side])
    assert (twice.kind, twice.object_id) == ("doubled box", TRUCK)
    missed, false = causes(seen, [HIDDEN_BOX, OPEN_BOX, side])
    assert (missed.kind, false.kind, false.object_id) == ("no box", "badly placed", TRUCK)
    other = the_one(seen, [HIDDEN_BOX, OPEN_BOX, side], objects=(HIDDEN, OPEN))
    assert (other.kind, other.object_id) == ("not evaluated", TRUCK)


def test_every_error_has_one_cause_whatever_the_threshold_and_it_goes_to_json() -> None:
    of, rng = frame(OFTEN), np.random.default_rng(5)
    found = [
        beside(box, *rng.normal(0, 1.0, 2), score=float(rng.random())) for box in 4 * [TRUCK_BOX, HIDDEN_BOX, OPEN_BOX]
    ]
    known = table(of, found)
    for score in (0.0, 0.3, 0.6, 1.0):
        for iou in (0.3, 0.5, 0.7):
            made = frame_causes(known, of, score, iou)
            assert len({(one.error, one.object_id if one.error == "missed" else one.rank) for one in made}) == len(made)
            assert all(one.kind in (MISSED if one.error == "missed" else FALSE) for one in made)
            kept = int(np.count_nonzero(known.score >= score))
            hits = 3 - sum(one.error == "missed" for one in made)
            assert sum(one.error == "false" for one in made) == kept - hits
            assert msgspec.json.decode(msgspec.json.encode(made), type=list[ErrorCause]) == made


def test_a_frame_of_other_data_is_named() -> None:
    of = frame(OFTEN)
    known: DetectionTable = table(of, [TRUCK_BOX])
    with pytest.raises(DataError, match="frame 7: agents: expected the ego 5, found 1000, 1001"):
        frame_causes(replace(known, ego_id=np.array([5])), of, 0.3, 0.5)
    with pytest.raises(DataError, match="frame 7: truth: expected the object 4444, found none of that id"):
        frame_causes(replace(known, object_id=np.array([TRUCK, HIDDEN, 4444])), of, 0.3, 0.5)
