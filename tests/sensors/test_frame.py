import numpy as np
import pytest

from sensors.frame import BY_EGO, BY_HELPER, BY_NOBODY, AgentFrame, Frame, agent_order, count_points
from sensors.sweep import make_sweep
from sim.boxes import Boxes


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
