"""Beams: directions of all rays of a sweep in the sensor frame, in blocks of columns for ray packets.

Columns come in blocks of `BLOCK`: the sensor's pose is known at the borders of blocks and runs straight in between
(at 10 Hz and 1000 columns a sensor that turns at 1 rad/s is off a true arc by less than 0.04 mm at 120 m), and
packets of rays never straddle one.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sensors.optics.livox import rosette_axes
from sensors.spec import LidarSpec

BLOCK = 16
"""Columns per block."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Beams:
    """Rays of one sweep: S sub-rays for each of R rings and W columns, W a multiple of `BLOCK`, at least C.

    Attributes:
        columns: C, the fired columns; those beyond repeat the last.
        axis: (3, R, W) float32 unit directions of the beams in the sensor frame: where returns are reported.
        subray: (S, 3, R, W) float32 unit directions of the rays; for S = 1 they are the axis.
        firing_share: (R,) float32 firing time of each beam, as a share of its column.
        reach: (R, 2) float32 nearest and farthest range, m.
        fan: azimuth and elevation of columns and rings, None for a rosette, which has neither.
    """

    columns: int
    axis: NDArray[np.float32]
    subray: NDArray[np.float32]
    firing_share: NDArray[np.float32]
    reach: NDArray[np.float32]
    fan: "Fan | None"

    @property
    def rings(self) -> int:
        """Number of beams."""
        return self.axis.shape[1]

    @property
    def blocks(self) -> int:
        """Number of blocks of columns."""
        return self.axis.shape[2] // BLOCK


@dataclass(frozen=True, slots=True, eq=False)
class Fan:
    """Angles of a spinning sensor's grid: ray (r, c) points at `azimuth[c]` and `elevation[r]`, within `spread`.

    Attributes:
        azimuth: (W,) float64 rad.
        elevation: (R,) float64 rad.
        spread: largest angle of a ray to its column's azimuth or its ring's elevation, rad.
    """

    azimuth: NDArray[np.float64]
    elevation: NDArray[np.float64]
    spread: float


def beams_of(spec: LidarSpec, time_s: float) -> Beams:
    """Return the rays of the sweep around `time_s`; only a rosette's depend on it."""
    if not spec.prisms:
        return _spinning(spec)
    azimuth, elevation = rosette_axes(spec, time_s + spec.time_offset)
    return _beams(spec, _padded(azimuth), _padded(elevation), None)


@lru_cache(maxsize=8)
def _spinning(spec: LidarSpec) -> Beams:
    azimuth = _padded(spec.azimuth)
    # The same angle across the beam is more azimuth the steeper the beam points.
    level = np.cos(min(np.abs(spec.elevation).max() + halo(spec), 0.5 * np.pi))
    spread = float(np.abs(spec.azimuth_offset).max() + min(halo(spec) / max(level, 1e-9), np.pi))
    fan = Fan(azimuth, spec.elevation, spread)
    return _beams(spec, azimuth + spec.azimuth_offset[:, None], spec.elevation[:, None], fan)


def _padded(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Repeat the last column up to a whole number of blocks."""
    missing = -columns.shape[-1] % BLOCK
    return np.concatenate([columns, np.repeat(columns[..., -1:], missing, axis=-1)], axis=-1)


def _beams(spec: LidarSpec, azimuth: NDArray[np.float64], elevation: NDArray[np.float64], fan: Fan | None) -> Beams:
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    across, up = _subray_offsets(spec)
    # Tilting by small angles: across along the horizon, up along the meridian.
    axis = _unit(azimuth, elevation)
    horizon = _unit(azimuth + 0.5 * np.pi, np.zeros_like(elevation))
    meridian = _unit(azimuth, elevation + 0.5 * np.pi)
    tilted = axis + across[:, None, None, None] * horizon + up[:, None, None, None] * meridian
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    return Beams(
        columns=spec.columns,
        axis=axis.astype(np.float32),
        subray=tilted.astype(np.float32),
        firing_share=spec.firing_share.astype(np.float32),
        reach=spec.beam_range.astype(np.float32),
        fan=fan,
    )


def _unit(azimuth: NDArray[np.float64], elevation: NDArray[np.float64]) -> NDArray[np.float64]:
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def _subray_offsets(spec: LidarSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (S,) angles across and up of equal parts of a Gaussian beam, rad.

    The beam's radius at 1/e^2 is two standard deviations. Four rays at one standard deviation on both axes have its
    second moments; so have eight, four at the root mean square radius of the inner half of the energy and four at that
    of the outer half.
    """
    vertical = spec.divergence_rad if spec.divergence_vertical_rad is None else spec.divergence_vertical_rad
    diagonal = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    upright = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    inner, outer = np.sqrt(2.0 - 2.0 * np.log(2.0)), np.sqrt(2.0 + 2.0 * np.log(2.0))
    patterns = {
        1: np.zeros((1, 2)),
        4: diagonal,
        8: np.concatenate([inner * diagonal / np.sqrt(2.0), outer * upright]),
    }
    across, up = patterns[spec.subrays].T
    return across * spec.divergence_rad / 4.0, up * vertical / 4.0


def halo(spec: LidarSpec) -> float:
    """Return the largest angle of a ray to its beam's axis: divergence and five standard deviations of jitter, rad."""
    vertical = spec.divergence_rad if spec.divergence_vertical_rad is None else spec.divergence_vertical_rad
    widest = 0.5 * max(spec.divergence_rad, vertical) if spec.subrays > 1 else 0.0
    return widest + 5.0 * float(np.radians(spec.angle_noise_deg))
