"""Motion of bodies between steps: trailing wheels, velocities, accelerations."""

import numpy as np
import pytest

from sim.traffic.sumo.motion import BodyMotion

ONE = np.array([0])


def follow(motion: BodyMotion, x: float, y: float, angle_deg: float) -> float:
    return float(motion.follow(ONE, np.array([[x, y]]), np.array([angle_deg]), np.array([4.0]))[0])


def test_the_first_heading_is_the_given_one_and_later_ones_follow_the_front() -> None:
    motion = BodyMotion(0.1)
    motion.make_room(1)
    assert follow(motion, 0.0, 0.0, 90.0) == pytest.approx(90.0)
    # The wheels are 2.6 m behind the front: they turn towards it, whatever the simulation says.
    assert follow(motion, 1.0, 1.0, 45.0) == pytest.approx(90.0 - np.degrees(np.arctan2(1.0, 3.6)))


def test_lifted_wheels_take_the_next_heading_as_given() -> None:
    motion = BodyMotion(0.1)
    motion.make_room(1)
    follow(motion, 0.0, 0.0, 90.0)
    motion.lift(0)
    assert follow(motion, 1.0, 1.0, 45.0) == pytest.approx(45.0)


def test_velocities_are_differences_and_a_new_body_does_not_accelerate() -> None:
    motion = BodyMotion(0.5)
    motion.make_room(1)
    assert motion.is_new(ONE).all()
    velocity, acceleration = motion.velocities(ONE, np.array([[0.0, 0.0]]), np.array([[3.0, 0.0]]))
    assert velocity.tolist() == [[3.0, 0.0]] and acceleration.tolist() == [[0.0, 0.0]]
    motion.make_room(2)  # a second body leaves the first as it is
    assert motion.is_new(np.array([0, 1])).tolist() == [False, True]
    velocity, acceleration = motion.velocities(ONE, np.array([[2.0, 0.0]]), np.zeros((1, 2)))
    assert velocity.tolist() == [[4.0, 0.0]] and acceleration.tolist() == [[2.0, 0.0]]
