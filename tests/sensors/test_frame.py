import numpy as np
import pytest

from sensors.frame import BY_EGO, BY_HELPER, BY_NOBODY, AgentFrame, Frame, Region, agent_order, count_points
from sensors.sweep import make_sweep
from sim.boxes import Boxes
from sim.errors import DataError
from sim.geometry import pose_matrix


def frame_of(points_on: np.ndarray) -> Frame:
    sweep = make_sweep(np.ones((2, 3)))
    agent = AgentFrame(1000, "vehicle", np.eye(4), 0.0, sweep)
    boxes = Boxes.from_array(np.ones((1, 7)), object_id=[1000])
    return Frame(0, 0.0, (agent,), boxes, np.zeros((1, 2)), points_on)


def test_agents_are_ordered_as_text_with_roadside_units_last() -> None:
    assert agent_order([-1, 1002, 999, 10000, -2]) == [10000, 1002, 999, -1, -2]


def test_points_are_counted_per_object() -> None:
    sweep = make_sweep(np.ones((5, 3)), object_id=np.array([-1, 1005, 1005, 1001, 2000]))
    assert count_points(sweep, np.array([1001, 1003, 1005])).tolist() == [1, 0, 2]
    assert count_points(sweep, np.zeros(0, np.int64)).tolist() == []


def test_a_frame_checks_its_shapes() -> None:
    frame_of(np.zeros((1, 1), np.int32))
    with pytest.raises(ValueError, match="points_on"):
        frame_of(np.zeros((2, 1), np.int32))


def test_sweeps_are_replaced_in_order() -> None:
    frame = frame_of(np.zeros((1, 1), np.int32))
    other = frame.with_sweeps([make_sweep(np.zeros((0, 3)))])
    assert len(other.agent(1000).sweep) == 0
    assert len(frame.agent(1000).sweep) == 2
    with pytest.raises(KeyError):
        frame.agent(7)


def test_an_object_is_seen_by_the_ego_by_a_helper_only_or_unseen() -> None:
    agents = tuple(AgentFrame(i, "vehicle", np.eye(4), 0.0, make_sweep(np.zeros((0, 3)))) for i in (1000, 1001, 1002))
    boxes = Boxes.from_array(np.ones((4, 7)), object_id=np.arange(4))
    points = np.array([[9, 0, 0, 4], [0, 7, 0, 9], [0, 0, 0, 9]], np.int32)
    frame = Frame(0, 0.0, agents, boxes, np.zeros((4, 2)), points)
    assert frame.seen_by(1000).tolist() == [BY_EGO, BY_HELPER, BY_NOBODY, BY_EGO]
    assert frame.seen_by(1000, points=5).tolist() == [BY_EGO, BY_HELPER, BY_NOBODY, BY_HELPER]
    assert frame.seen_by(1002).tolist() == [BY_HELPER, BY_HELPER, BY_NOBODY, BY_EGO]
    with pytest.raises(KeyError):
        frame.seen_by(7)


CAR = [10.0, 2.0, -0.9, 4.0, 1.8, 1.5, 0.3]


def test_a_cloud_becomes_a_frame_with_its_boxes_in_the_world() -> None:
    points = np.array([[10.0, 2.0, -0.9, 0.5], [10.5, 2.1, -0.8, 1.0], [-5.0, 0.0, -1.7, 0.0]])
    frame = Frame.of_cloud(points, [CAR], pose_matrix([100.0, 0.0, 1.7], np.pi / 2), height=1.7, index=4, time_s=0.4)
    assert np.array_equal(frame.agents[0].sweep.points, points[:, :3].astype(np.float32))
    assert frame.agents[0].sweep.intensity.tolist() == [0.5, 1.0, 0.0]
    assert np.allclose(frame.truth.array, [[98.0, 10.0, 0.8, 4.0, 1.8, 1.5, 0.3 + np.pi / 2]])
    assert np.allclose(frame.agents[0].world_from_body[:3, 3], [100.0, 0.0, 0.0])
    assert frame.points_on.tolist() == [[2]]
    assert (frame.index, frame.time_s, frame.region) == (4, 0.4, None)


def test_clouds_of_several_agents_share_a_world() -> None:
    far = pose_matrix([20.0, 2.0, 0.0], np.pi)
    clouds = {7: (np.zeros((1, 3)), far), -1: ([[0.0, 0.0, 5.0]], np.eye(4)), 1: ([[10.0, 2.0, -0.9]], np.eye(4))}
    frame = Frame.of_clouds(clouds, Boxes.from_array([CAR, [20.0, 2.0, 0.0, 4.0, 2.0, 1.5, 0.0]], None, [-1, 7]))
    assert [(agent.agent_id, agent.kind) for agent in frame.agents] == [
        (1, "vehicle"),
        (7, "vehicle"),
        (-1, "roadside"),
    ]
    assert frame.truth.object_id.tolist() == [7, 8]
    assert frame.points_on.tolist() == [[0, 1], [1, 0], [0, 0]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": np.zeros((3, 2))}, r"points of agent 0: expected numbers of shape \(P, 3\)"),
        ({"points": [[0.0, 0.0, np.nan]]}, "points of agent 0: expected finite numbers"),
        ({"points": [[0.0, 0.0, 0.0, 200.0]]}, "expected 0 to 1, found 200 to 200; divide it by its full scale"),
        ({"points": np.zeros((0, 3)), "boxes": np.ones((2, 6))}, r"boxes: expected shape \(M, 7\)"),
        ({"points": np.zeros((0, 3)), "boxes": [[0.0] * 7]}, "boxes: expected finite numbers and positive sizes"),
        ({"points": np.zeros((0, 3)), "pose": np.zeros((4, 4))}, "pose: expected a"),
        ({"points": np.zeros((0, 3)), "boxes": [CAR], "velocity": [1.0]}, "velocity: expected shape"),
    ],
)
def test_a_cloud_that_is_none_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(DataError, match=message):
        Frame.of_cloud(**arguments)


def test_a_region_judges_by_the_image_and_what_is_ignored() -> None:
    # A camera at the origin looks along x; 100 px are 45 degrees from the middle of 200 px.
    camera = np.array([[100.0, -100.0, 0.0, 0.0], [100.0, 0.0, -100.0, 0.0], [1.0, 0.0, 0.0, 0.0]])
    region = Region(camera, (200, 200), np.array([[100.0, 0.0, 200.0, 200.0]]))
    centers = [[10.0, 3.0], [10.0, -3.0], [10.0, 11.0], [-10.0, 3.0]]
    boxes = Boxes.from_array([[x, y, 0.0, 4.0, 1.8, 1.5, 0.0] for x, y in centers])
    assert region.counts(boxes).tolist() == [True, False, False, False]
    turned = pose_matrix([5.0, 5.0, 1.0], 2.0)
    assert region.transform(turned).counts(boxes.transform(turned)).tolist() == [True, False, False, False]
    around = Region(ignored=boxes[:1])
    assert around.counts(boxes).tolist() == [False, True, True, True]
