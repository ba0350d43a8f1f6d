"""The batched filter is the textbook's where that is linear, and turns as a car does where it is not."""

import numpy as np
import pytest
from numpy.typing import NDArray

from dsrc.closed_loop.tracking.filter import (
    RATE,
    VX,
    VY,
    YAW,
    Parameters,
    State,
    corrected,
    predicted,
    with_pose,
    with_velocity,
    without_slip,
)

STILL = dict(
    position_m=0.2,
    length_error=0.0,
    yaw_rad=0.1,
    speed_mps=15.0,
    sideways_mps=3.0,
    acceleration=0.0,
    sideways_acceleration=0.0,
    turning=0.0,
    curvature_per_m=0.0,
    lateral_mps2=0.0,
    slip_mps=0.2,
    slip_rad=0.0,
)
"""A motion without noise."""


def parameters(n: int, **changed: float) -> Parameters:
    return Parameters(**{name: np.full(n, value) for name, value in (STILL | changed).items()})


def states(n: int, seed: int = 0) -> State:
    rng = np.random.default_rng(seed)
    mean = rng.normal(size=(n, 6)) * [30.0, 30.0, 8.0, 8.0, 1.0, 0.3]
    root = rng.normal(size=(n, 6, 6)) * 0.3
    return State(mean, root @ root.transpose(0, 2, 1) + 0.01 * np.eye(6))


def test_without_a_turn_rate_it_is_the_linear_kalman_filter() -> None:
    """Textbook: x' = F x, P' = F P F' + Q; K = P H' S^-1, P' = (I - K H) P (I - K H)' + K R K'."""
    rng = np.random.default_rng(1)
    n, walk = 5, 0.7
    p = parameters(n, acceleration=walk, sideways_acceleration=walk)
    state = states(n)
    state.mean[:, RATE] = 0.0
    state.covariance[:, YAW:, :] = state.covariance[:, :, YAW:] = 0.0
    state.covariance[:, YAW, YAW] = 0.1
    x, cov = state.mean[:, :4].copy(), state.covariance[:, :4, :4].copy()
    measure = np.eye(4)[:2]
    for dt in (0.1, 0.0, 0.35, 0.02, 1.0):
        z, noise = x[:, :2] + rng.normal(size=(n, 2)), np.diag([0.04, 0.09])
        state = predicted(state, dt, p, turn_time_s=4.0)
        state = with_pose(state, z, np.broadcast_to(noise, (n, 2, 2)), np.zeros(n), np.full(n, 0.1))
        f = np.eye(4)
        f[0, 2] = f[1, 3] = dt
        q = walk**2 * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2))
        for i in range(n):
            x[i], cov[i] = f @ x[i], f @ cov[i] @ f.T + q
            gain = cov[i] @ measure.T @ np.linalg.inv(measure @ cov[i] @ measure.T + noise)
            x[i] += gain @ (z[i] - measure @ x[i])
            rest = np.eye(4) - gain @ measure
            cov[i] = rest @ cov[i] @ rest.T + gain @ noise @ gain.T
    assert state.mean[:, :4] == pytest.approx(x, abs=1e-9)
    assert state.covariance[:, :4, :4] == pytest.approx(cov, abs=1e-9)


def test_one_long_prediction_of_a_walker_is_many_short_ones() -> None:
    p = parameters(3, acceleration=0.7, sideways_acceleration=0.7)
    state = states(3)
    state.mean[:, RATE] = 0.0
    state.covariance[:, RATE, :] = state.covariance[:, :, RATE] = 0.0
    once, often = predicted(state, 0.6, p, 4.0), state
    for _ in range(6):
        often = predicted(often, 0.1, p, 4.0)
    assert often.mean == pytest.approx(once.mean, abs=1e-12)
    assert often.covariance == pytest.approx(once.covariance, abs=1e-12)


@pytest.mark.parametrize("rate", [-0.5, 0.0, 1e-5, 0.4])
def test_a_constant_turn_stays_on_its_circle(rate: float) -> None:
    speed, yaw, dt = 8.0, 0.7, 1.5
    mean = np.array([[3.0, -2.0, speed * np.cos(yaw), speed * np.sin(yaw), yaw, rate]])
    after = predicted(State(mean, np.zeros((1, 6, 6))), dt, parameters(1), turn_time_s=1e9).mean[0]
    fine = np.linspace(0.0, dt, 20001)
    path = speed * np.column_stack([np.cos(yaw + rate * fine), np.sin(yaw + rate * fine)])
    assert after[:2] == pytest.approx(mean[0, :2] + np.trapezoid(path, fine, axis=0), abs=1e-6)
    assert after[VX : VY + 1] == pytest.approx(path[-1], abs=1e-6)
    assert after[YAW] == pytest.approx(yaw + rate * dt, abs=1e-6)


@pytest.mark.parametrize("rate", [-0.8, 0.0, 3e-5, 0.3])
def test_the_covariance_moves_by_the_derivative_of_the_motion(rate: float) -> None:
    state = states(1, seed=3)
    state.mean[0, RATE] = rate
    step, dt = 1e-5, 0.4

    def moved(mean: NDArray[np.float64]) -> NDArray[np.float64]:
        return predicted(State(mean[None], np.zeros((1, 6, 6))), dt, parameters(1), 4.0).mean[0]

    unit = np.eye(6) * step
    derivative = np.column_stack([(moved(state.mean[0] + e) - moved(state.mean[0] - e)) / (2 * step) for e in unit])
    after = predicted(state, dt, parameters(1), 4.0)
    assert after.covariance[0] == pytest.approx(derivative @ state.covariance[0] @ derivative.T, abs=1e-6)


def test_the_order_of_independent_measurements_does_not_matter() -> None:
    state, xy, velocity = states(4), np.zeros((4, 2)), np.ones((4, 2))
    noise = np.broadcast_to(0.1 * np.eye(2), (4, 2, 2))
    blind = np.zeros(4), np.full(4, 1e6)
    first = with_velocity(with_pose(state, xy, noise, *blind), velocity, 0.3)
    second = with_pose(with_velocity(state, velocity, 0.3), xy, noise, *blind)
    assert second.mean == pytest.approx(first.mean, abs=1e-6)
    assert second.covariance == pytest.approx(first.covariance, abs=1e-6)


def test_wheels_do_not_let_a_car_move_sideways_but_let_it_stand_in_any_direction() -> None:
    mean = np.array([[0.0, 0.0, 10.0, 2.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]])
    state = State(mean, np.broadcast_to(np.diag([0.1, 0.1, 1.0, 1.0, 0.01, 0.1]), (2, 6, 6)).copy())
    after = without_slip(state, parameters(2))
    slip = after.mean[:, VY] * np.cos(after.mean[:, YAW]) - after.mean[:, VX] * np.sin(after.mean[:, YAW])
    assert abs(slip[0]) < 0.7
    assert 0.0 < after.mean[0, YAW] < np.arctan2(2.0, 10.0)
    assert after.mean[1] == pytest.approx(mean[1])
    assert after.covariance[1, YAW, YAW] == pytest.approx(0.01)


def test_a_residual_beyond_the_limit_pulls_no_more_than_one_at_the_limit() -> None:
    """Variance 1, measured with 3: the deviation of the residual is 2, its limit 6."""
    state = State(np.zeros((2, 6)), np.broadcast_to(np.eye(6), (2, 6, 6)))
    cross, innovation = np.broadcast_to(np.eye(6)[:, :1], (2, 6, 1)), np.full((2, 1, 1), 4.0)
    pull = corrected(state, cross, innovation, np.array([[6.0], [60.0]]), limit=np.array([3.0])).mean[:, 0]
    assert pull[0] == pytest.approx(6.0 / 4.0)
    assert 0.0 < pull[1] < pull[0]
