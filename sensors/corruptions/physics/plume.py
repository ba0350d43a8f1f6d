"""Plumes of spray behind vehicles on a wet road: geometry, extinction and patches.

A vehicle of width W and height H at speed V meets rho w h of water per metre of its way: h the height of the water, w
the width of its tyres. A share of it becomes airborne drops of diameter d, which fall at v:

    share = 0.15 V / (25 m/s)        d = 0.8 mm (6 m/s) / V        v = (4000 / s) d

The drops fill a wake that is W wide and 0.6 H high where it begins, at the rear end, and grows with the cube root of
the distance x, as wakes of bluff bodies do: by s = (1 + x / L)^(1/3) each way for a vehicle of length L. In it the mass
of water per volume m and the extinction of light are

    m = share rho w h / (0.6 H W s^2) * exp(-x v / (0.6 H V))
    alpha = 1.5 Q m / (rho d) * exp(-y^2 pi / (W s)^2) * exp(-z^2 pi / (1.2 H s)^2) * patches,        Q = 2

y across and z above the road. So alpha grows with the water and with V^2, and so does the length of the plume with V^2:
fast vehicles make small drops that fall slowly. A car at 90 km/h on 0.5 mm of water has 0.3 per metre and a tail of
29 m, at 30 km/h 0.03 per metre and 3 m. Turbulence gathers drops into patches: a log-normal field of mean 1 that stands
still in the world while vehicles pass.

Sources. The size of drops from a grooved tyre, 0.8 mm at a Weber number of 2700 and falling with its square root:
Radovich (thesis, University of Southern California), taken to be at 6 m/s, the speed of his rig. The share is chosen so
that a truck at 90 km/h on 1 mm of water lifts 0.03 kg/m3, the densest that the tool of the Federal Highway
Administration shows for 25 mm/h of rain (Flintsch et al., TechBrief FHWA-HRT-15-062, 2015); that it grows with V is
assumed. Fall speed: Rogers and Yau, A Short Course in Cloud Physics. That LiDARs see spray as patches behind the
vehicle, measured at 50 to 130 km/h: Linnhoff et al., Simulating Road Spray Effects in Automotive Lidar Sensor Models
(2022); that spray of a vehicle cutting in disturbs for up to four seconds: Walz et al., A Benchmark for Spray from
Nearby Cutting Vehicles (2021). Assumed: height and shape of the plume, size and strength of the patches, no wind,
straight paths, no spray of bicycles.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.frame import Frame
from sim.boxes import CLASSES

WATER_DENSITY = 1000.0
"""kg/m3."""

LEAST_SPEED_MPS = 3.0
"""Least speed of a vehicle with spray, m/s."""

FAINTEST_PER_M = 2e-3
"""Extinction at the end of a plume, 1/m."""

PERIOD_M = 19.2
"""Period of the field of patches, m."""

_TYRES = {"car": 0.22, "van": 0.22, "truck": 0.44, "bus": 0.44, "motorcycle": 0.20}
_SHARE_PER_MPS = 0.15 / 25.0
_MOST_SHARE = 0.5
_DROP_M2_PER_S = 0.8e-3 * 6.0
_FALL_PER_S = 4000.0
_MOST_FALL_MPS = 9.0
_HEIGHT = 0.6
_ONSET_M = 0.5
_EXTINCTION_EFFICIENCY = 2.0
_WAY_M = np.arange(0.0, 120.0, 0.5)

_CELLS = 48
_CELL_M = PERIOD_M / _CELLS
_PATCHINESS = 1.0
_GOLDEN = np.array([0.7548776662, 0.5698402910, 0.4301597090])


@dataclass(frozen=True, slots=True, eq=False)
class Plume:
    """Plume of spray behind one vehicle.

    Attributes:
        world_from_plume: (4, 4) pose at the frame's time: x backwards from the rear end, z up from the road.
        speed: of the vehicle, m/s.
        width, height: of the wake where it begins, m.
        growth_m: distance over which the wake grows, L, m.
        extinction: where it begins, in its middle on the road, 1/m.
        tail_m: distance over which drops fall out, m.
        length_m: length, m.
        shift: (3,) offset in the field of patches, cells.
    """

    world_from_plume: NDArray[np.float64]
    speed: float
    width: float
    height: float
    growth_m: float
    extinction: float
    tail_m: float
    length_m: float
    shift: NDArray[np.float64]

    @property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) lowest and highest x, y, z of noticeable spray, m."""
        grown = (1.0 + self.length_m / self.growth_m) ** (1.0 / 3.0)
        side, top = 1.1 * self.width * grown, 2.2 * self.height * grown
        return np.array([[0.0, -side, 0.0], [self.length_m, side, top]])

    def mean_extinction(
        self, x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return (...,) mean extinction at places (...,) in the plume's frame, without patches, 1/m."""
        behind = np.maximum(x, np.float32(0.0))
        shrunk = 1.0 / np.cbrt(1.0 + behind * np.float32(1.0 / self.growth_m))
        across, up = y * shrunk, z * shrunk
        off = np.float32(np.pi / self.width**2) * across**2 + np.float32(0.25 * np.pi / self.height**2) * up**2
        drops = np.exp(-(off + behind * np.float32(1.0 / self.tail_m))) * shrunk**2
        onset = np.minimum(behind * np.float32(1.0 / _ONSET_M), np.float32(1.0))
        inside = (x < np.float32(self.length_m)) & (z > np.float32(0.0))
        return np.asarray(np.float32(self.extinction) * drops * onset * inside)


def plumes_of(frame: Frame, water_mm: float) -> list[Plume]:
    """Return the plumes behind the moving vehicles of a frame.

    Args:
        frame: boxes, classes and velocities of the vehicles.
        water_mm: height of the water on the road, mm.
    """
    speed = np.hypot(*frame.velocity.T) if len(frame.truth) else np.zeros(0)
    moving = np.flatnonzero(speed >= LEAST_SPEED_MPS)
    made = [_plume(frame, int(row), float(speed[row]), water_mm) for row in moving]
    return [plume for plume in made if plume is not None]


def _plume(frame: Frame, row: int, speed: float, water_mm: float) -> Plume | None:
    truth = frame.truth
    tyres = _TYRES.get(CLASSES[truth.label[row]])
    length, width, height = truth.size[row]
    if tyres is None or min(length, width, height) <= 0.0 or water_mm <= 0.0:
        return None
    drop_m = _DROP_M2_PER_S / speed
    share = min(_SHARE_PER_MPS * speed, _MOST_SHARE)
    lifted = share * WATER_DENSITY * tyres * width * water_mm * 1e-3
    top = _HEIGHT * height
    extinction = 1.5 * _EXTINCTION_EFFICIENCY * lifted / (top * width) / (WATER_DENSITY * drop_m)
    tail_m = top * speed / min(_FALL_PER_S * drop_m, _MOST_FALL_MPS)
    if extinction <= FAINTEST_PER_M:
        return None
    along = extinction * np.exp(-_WAY_M / tail_m) / (1.0 + _WAY_M / length) ** (2.0 / 3.0)
    forward = np.append(frame.velocity[row] / speed, 0.0)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = -forward, [forward[1], -forward[0], 0.0], [0.0, 0.0, 1.0]
    pose[:3, 3] = truth.center[row] - forward * 0.5 * length - [0.0, 0.0, 0.5 * height]
    return Plume(
        world_from_plume=pose,
        speed=speed,
        width=width,
        height=top,
        growth_m=length,
        extinction=extinction,
        tail_m=tail_m,
        length_m=float(_WAY_M[np.flatnonzero(along > FAINTEST_PER_M)[-1]]),
        shift=(truth.object_id[row] * _GOLDEN % 1.0) * _CELLS,
    )


def draw_patches(rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the field of patches of a drive, a periodic cube of standard normal numbers."""
    return rng.standard_normal((_CELLS,) * 3, np.float32)


def patches_at(field: NDArray[np.float32], plume: Plume, world: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (...,) density of a plume relative to its mean at (3, ...) places in the world; 1 on average."""
    # SciPy takes half a second to import, which most users of the registry need not wait for.
    from scipy.ndimage import map_coordinates

    shift = plume.shift.astype(np.float32).reshape(3, *(1,) * (world.ndim - 1))
    normal = map_coordinates(field, world * np.float32(1.0 / _CELL_M) + shift, order=1, mode="grid-wrap")
    return np.asarray(np.exp(np.float32(_PATCHINESS) * normal) * np.float32(1.0 / _MEAN_PATCH))


def _mean_patch() -> float:
    """Return the mean of exp(_PATCHINESS * n) for n between the points of a field of independent normal numbers."""
    # Between points n is a mean of neighbours: its variance is that of the weights, (1 - s)^2 + s^2 along each axis.
    share = (np.arange(64) + 0.5) / 64
    axis = (1.0 - share) ** 2 + share**2
    variance = axis[:, None, None] * axis[:, None] * axis
    return float(np.exp(0.5 * _PATCHINESS**2 * variance).mean())


_MEAN_PATCH = _mean_patch()
