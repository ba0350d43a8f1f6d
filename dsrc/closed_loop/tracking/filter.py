"""Extended Kalman filter of turning road users, all at once.

State of a road user: x, y, vx, vy, yaw, yaw rate; m, m/s, rad and rad/s in the world frame. Velocity and yaw turn with
the yaw rate (coordinated turn, Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation,
section 11.7). The velocity is Cartesian, so that a standing object has no singular direction and one without a turn
rate is the linear constant-velocity filter; wheels tie it to the yaw by a measurement of their own (`without_slip`).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from sim.geometry import wrap_angle
from sim.rows import Rows

Array = NDArray[np.float64]

X, Y, VX, VY, YAW, RATE = range(6)
_POSE = np.array([X, Y, YAW])
_POSE_LIMIT = np.array([np.inf, np.inf, 3.0])
_SLIP_LIMIT = np.array([3.0])
_QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


class Parameters(NamedTuple):
    """Columns (N,) of `Motion`, one row per road user; `slip_mps` is infinite where it moves in any direction."""

    position_m: Array
    length_error: Array
    yaw_rad: Array
    speed_mps: Array
    sideways_mps: Array
    acceleration: Array
    sideways_acceleration: Array
    turning: Array
    curvature_per_m: Array
    lateral_mps2: Array
    slip_mps: Array
    slip_rad: Array

    @classmethod
    def of(cls, table: Array) -> Self:
        """Return the columns of a table (N, 12)."""
        return cls(*table.T)


@dataclass(frozen=True, slots=True, eq=False)
class State(Rows):
    """Estimates of N road users, world frame.

    Attributes:
        mean: (N, 6) x, y, vx, vy, yaw, yaw rate.
        covariance: (N, 6, 6).
    """

    mean: Array
    covariance: Array

    def taken(self, rows: NDArray[np.integer]) -> "State":
        """Return the estimates of some rows, which ascend; the state itself, where these are all."""
        return self if len(rows) == len(self) else self[rows]

    def replaced(self, rows: NDArray[np.integer], other: "State") -> "State":
        """Return the estimates with some rows, which ascend, from another state."""
        if len(rows) == len(self):
            return other
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[rows], covariance[rows] = other.mean, other.covariance
        return State(mean, covariance)


def rotated(yaw: Array, along: Array, across: Array) -> Array:
    """Return (N, 2, 2) world-frame covariances of variances (N,) along and across headings (N,)."""
    c, s = np.cos(yaw), np.sin(yaw)
    out = np.zeros((len(yaw), 2, 2))
    out[:, 0, 0] = c * c * along + s * s * across
    out[:, 1, 1] = s * s * along + c * c * across
    out[:, 0, 1] = out[:, 1, 0] = c * s * (along - across)
    return out


def turned(state: State, angle: Array) -> State:
    """Return the state with headings turned by angles (N,), rad."""
    mean = state.mean.copy()
    mean[:, YAW] = wrap_angle(mean[:, YAW] + angle)
    return State(mean, state.covariance)


def lying_across(state: State) -> State:
    """Return the state of road users whose box lies across them: uncertain a quarter turn from where it was."""
    turn = block_diag(_QUARTER, _QUARTER, np.eye(2))
    across = State(state.mean, turn @ state.covariance @ turn.T)
    return turned(across, np.full(len(state.mean), 0.5 * np.pi))


def motion_decides(state: State, least_mps: float) -> NDArray[np.bool_]:
    """Return the (N,) mask of motions of at least a speed, m/s, that are certain enough to decide the heading."""
    squared = state.mean[:, VX] ** 2 + state.mean[:, VY] ** 2
    return np.asarray((squared > least_mps**2) & (squared > 9.0 * _velocity_variance(state)), bool)


def facing_forward(state: State, least_mps: float) -> State:
    """Return the state with headings along the motions that decide them and are elsewhere, see `motion_decides`."""
    vx, vy = state.mean[:, VX], state.mean[:, VY]
    speed = np.hypot(vx, vy)
    along = np.cos(state.mean[:, YAW]) * vx + np.sin(state.mean[:, YAW]) * vy
    astray = motion_decides(state, least_mps) & (along < 0.5 * speed)
    if not astray.any():
        return state
    mean, covariance = state.mean.copy(), state.covariance.copy()
    mean[astray, YAW] = np.arctan2(vy[astray], vx[astray])
    covariance[astray, YAW, :] = covariance[astray, :, YAW] = 0.0
    covariance[astray, YAW, YAW] = _velocity_variance(state)[astray] / speed[astray] ** 2
    return State(mean, covariance)


def turn_rate_deviation(speed: Array, parameters: Parameters) -> Array:
    """Return (N,) standard deviations of the turn rate at speeds (N,), rad/s: curvature bounds it, then grip."""
    return np.minimum(parameters.curvature_per_m * speed, parameters.lateral_mps2 / np.maximum(speed, 1e-3))


def predicted(state: State, dt: float, parameters: Parameters, turn_time_s: float) -> State:
    """Return the state after a time.

    Args:
        dt: time, s, not negative.
        turn_time_s: correlation time of the turn rate, s: it decays towards 0 as an Ornstein-Uhlenbeck process.
    """
    n = len(state.mean)
    if dt == 0.0 or n == 0:
        return state
    vx, vy, yaw, rate = state.mean[:, VX:].T
    keep = math.exp(-dt / turn_time_s)
    turn_s = -turn_time_s * math.expm1(-dt / turn_time_s)
    half = 0.5 * turn_s * rate
    # The path is a chord of the turned arc: its length shrinks by sin(u)/u and its direction turns by u.
    chord = dt * np.sinc(half / np.pi)
    safe = np.where(np.abs(half) > 1e-4, half, 1.0)
    chord_slope = np.where(np.abs(half) > 1e-4, (dt * np.cos(half) - chord) / safe, -dt * half / 3.0)
    c1, s1, c2, s2 = np.cos(half), np.sin(half), np.cos(2.0 * half), np.sin(2.0 * half)

    mean = state.mean.copy()
    ahead_x, ahead_y = c1 * vx - s1 * vy, s1 * vx + c1 * vy
    mean[:, X] += chord * ahead_x
    mean[:, Y] += chord * ahead_y
    mean[:, VX] = c2 * vx - s2 * vy
    mean[:, VY] = s2 * vx + c2 * vy
    mean[:, YAW] = wrap_angle(yaw + 2.0 * half)
    mean[:, RATE] = keep * rate

    jacobian = np.zeros((n, 6, 6))
    jacobian[:, X, X] = jacobian[:, Y, Y] = jacobian[:, YAW, YAW] = 1.0
    jacobian[:, X, VX] = jacobian[:, Y, VY] = chord * c1
    jacobian[:, Y, VX] = chord * s1
    jacobian[:, X, VY] = -chord * s1
    jacobian[:, VX, VX] = jacobian[:, VY, VY] = c2
    jacobian[:, VY, VX] = s2
    jacobian[:, VX, VY] = -s2
    jacobian[:, X, RATE] = 0.5 * turn_s * (chord_slope * ahead_x - chord * ahead_y)
    jacobian[:, Y, RATE] = 0.5 * turn_s * (chord_slope * ahead_y + chord * ahead_x)
    jacobian[:, VX, RATE] = -turn_s * mean[:, VY]
    jacobian[:, VY, RATE] = turn_s * mean[:, VX]
    jacobian[:, YAW, RATE] = turn_s
    jacobian[:, RATE, RATE] = keep

    # White acceleration in the frame of the box, integrated over the time (Bar-Shalom, section 6.2.2).
    density = rotated(yaw, parameters.acceleration**2, parameters.sideways_acceleration**2)
    rate_variance = turn_rate_deviation(np.hypot(vx, vy), parameters) ** 2 * (1.0 - keep * keep)
    noise = np.zeros((n, 6, 6))
    noise[:, :2, :2] = density * (dt**3 / 3.0)
    noise[:, :2, 2:4] = noise[:, 2:4, :2] = density * (dt**2 / 2.0)
    noise[:, 2:4, 2:4] = density * dt
    noise[:, YAW, YAW] = parameters.turning**2 * dt + rate_variance * (dt**2 / 3.0)
    noise[:, YAW, RATE] = noise[:, RATE, YAW] = rate_variance * (dt / 2.0)
    noise[:, RATE, RATE] = rate_variance
    return State(mean, jacobian @ state.covariance @ jacobian.transpose(0, 2, 1) + noise)


def corrected(state: State, cross: Array, innovation: Array, residual: Array, limit: Array | None = None) -> State:
    """Return the state after a measurement.

    Args:
        cross: (N, 6, M) covariance of state and measurement, P H'.
        innovation: (N, M, M) covariance of the residual, H P H' + R.
        residual: (N, M) measured minus expected.
        limit: (M,) largest residuals of full weight, standard deviations; a larger one counts as one with an error
            that makes it that large (Huber's bounded influence).
    """
    if limit is not None:
        innovation = innovation.copy()
        diagonal = np.einsum("nii->ni", innovation)
        diagonal += np.maximum((residual / limit) ** 2 - diagonal, 0.0)
    transposed = cross.transpose(0, 2, 1)
    one = residual.shape[1] == 1
    gain = cross / innovation if one else np.linalg.solve(innovation, transposed).transpose(0, 2, 1)
    mean = state.mean + (gain @ residual[:, :, None])[:, :, 0]
    mean[:, YAW] = wrap_angle(mean[:, YAW])
    covariance = state.covariance - gain @ transposed
    return State(mean, 0.5 * (covariance + covariance.transpose(0, 2, 1)))


def with_pose(state: State, position: Array, variance: Array, yaw_residual: Array, yaw_deviation: Array) -> State:
    """Return the state after measured centres and headings.

    Args:
        position: (N, 2) m.
        variance: (N, 2, 2) of the positions, m2.
        yaw_residual: (N,) measured heading minus the state's, rad.
        yaw_deviation: (N,) standard deviation of the heading, rad.
    """
    residual = np.column_stack([position - state.mean[:, :2], yaw_residual])
    cross = state.covariance[:, :, _POSE]
    innovation = cross[:, _POSE]
    innovation[:, :2, :2] += variance
    innovation[:, 2, 2] += yaw_deviation**2
    return corrected(state, cross, innovation, residual, limit=_POSE_LIMIT)


def with_velocity(state: State, velocity: Array, deviation: float) -> State:
    """Return the state after measured velocities (N, 2), m/s, of one standard deviation."""
    cross = state.covariance[:, :, VX : VY + 1]
    innovation = cross[:, VX : VY + 1] + deviation**2 * np.eye(2)
    return corrected(state, cross, innovation, velocity - state.mean[:, VX : VY + 1])


def without_slip(state: State, parameters: Parameters) -> State:
    """Return the state after the knowledge that wheels roll along the box: the velocity across it is about 0."""
    c, s = np.cos(state.mean[:, YAW]), np.sin(state.mean[:, YAW])
    vx, vy = state.mean[:, VX], state.mean[:, VY]
    along, across = c * vx + s * vy, c * vy - s * vx
    derivative = np.zeros((len(c), 6, 1))
    derivative[:, VX, 0], derivative[:, VY, 0], derivative[:, YAW, 0] = -s, c, -along
    cross = state.covariance @ derivative
    # Velocity and yaw are both uncertain: the variance of their product is the second-order term of the filter.
    speed_variance = (
        c * c * state.covariance[:, VX, VX]
        + 2.0 * c * s * state.covariance[:, VX, VY]
        + s * s * state.covariance[:, VY, VY]
    )
    slip = parameters.slip_mps**2 + (parameters.slip_rad * along) ** 2 + speed_variance * state.covariance[:, YAW, YAW]
    innovation = (derivative * cross).sum(axis=1)[:, :, None] + slip[:, None, None]
    return corrected(state, cross, innovation, -across[:, None], limit=_SLIP_LIMIT)


def _velocity_variance(state: State) -> Array:
    """Return (N,) sums of the variances of the velocities along both axes, m2/s2."""
    return np.asarray(state.covariance[:, VX, VX] + state.covariance[:, VY, VY])
