"""Rain and snow of LISA (Kilic et al. 2021), as 3D_Corruptions_AD uses it too.

A beam of 3 mrad is a cone of volume V = pi / 3 r (r tan(3 mrad) / 2)^2 with n = N V drops larger than d0 = 0.05 mm in
it, rounded up or down at random. Each is at r U^(1/3), if that is more than r_min, and has the diameter
D = d0 - ln(1 - U) / rate. Target and drops answer with

    p0 = i exp(-2 alpha r) / r^2          pj = F exp(-2 alpha rj) min((D / (rj tan(3 mrad)))^2, 1) / rj^2

and p_min = 0.9 / r_max^2 is the weakest detected power. `strongest`: the point is lost if all are weaker; if a drop is
the strongest, the point is there, with intensity pj rj^2; else it is at r + N(0, 0.09 / sqrt(2 p0 / p_min)) with
i exp(-2 alpha r). `last`: the target, if p0 > p_min, else the farthest drop above p_min, else lost.

| severity     | 1   | 2    | 3      | 4     | 5    |
|--------------|-----|------|--------|-------|------|
| rate, mm/h   | 0.2 | 0.73 | 1.5625 | 3.125 | 7.29 |

Rates are those of 3D_Corruptions_AD; DSRC and Robo3D have no rain. LISA's r_max and r_min are 200 and 1.5 m, those of
3D_Corruptions_AD 120 and 0.9 m. Two models without drops: `average` dims only, for fogs of a given extinction; `goodin`
(Goodin et al. 2019) has alpha = 0.01 R^0.6, a deviation of the range of 0.02 r (1 - exp(-R))^2, and
p_min = 0.9 / (pi r_max^2).

| law of sizes         | number per m^3 and mm of diameter D (mm) at R mm/h | of    |
|----------------------|----------------------------------------------------|-------|
| `marshall_palmer`    | 8000 exp(-4.1 R^-0.21 D)                           | water |
| `gunn_marshall`      | 7600 R^-0.87 exp(-2.55 R^-0.48 D)                  | ice   |

Extinction is the sum of pi / 4 D^2 Q over 2000 diameters of 1e-5 to 10 mm, even in the logarithm. Q is Mie's for
spheres up to 60 wavelengths around, and its mean 2 + 1.992 x^(-2/3) beyond (Nussenzveig and Wiscombe 1980): no sum
over sizes sees its ripple. LISA's own Mie code takes half the circumference over the wavelength for x (`halved`),
which for rain adds 0.2 to 0.5 % to the extinction.

Quirks: points of intensity 0 are lost without a draw. The published code draws point by point; here only drops near
enough to be detected are drawn, whose number is binomial: the outcome has the same law, far faster. Lost points, at
the origin in LISA, leave the sweep.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings, check_range
from sensors.corruptions.published.cloud import Cloud, RandomSource, cloud_of, with_cloud
from sensors.sweep import ATTENUATED, SCATTERED, Sweep
from sim.geometry import Array

LOST, DROP, TARGET = range(3)
"""Values of `RainyCloud.label`, as in LISA."""

_WEAKEST = 0.9
_RARE = 35.0

SizeLaw = Literal["marshall_palmer", "gunn_marshall"]

WATER, ICE = 1.328, 1.3031
"""Refractive indices at 905 nm."""

_WAVELENGTH_MM = 905e-6
_DIAMETERS_MM = np.geomspace(1e-5, 10.0, 2000)
_LARGEST_SERIES = 60.0
_EDGE = 1.9923861


class Sizes(NamedTuple):
    """Exponential law of diameters.

    Attributes:
        density: number per m^3 and mm at diameter 0.
        rate: of the decay, 1/mm.
        refraction: refractive index.
    """

    density: float
    rate: float
    refraction: float

    def number(self, smallest_mm: float) -> float:
        """Return the number per m^3 of larger drops."""
        return self.density * float(np.exp(-self.rate * smallest_mm)) / self.rate

    @property
    def reflectivity(self) -> float:
        """Reflectivity of a drop as wide as the beam: |(m - 1) / (m + 1)|^2."""
        return ((self.refraction - 1.0) / (self.refraction + 1.0)) ** 2


def sizes_of(law: SizeLaw, rate_mm_h: float) -> Sizes:
    """Return the law of sizes at a rate of rain or snow > 0, mm/h."""
    if law == "marshall_palmer":
        return Sizes(8000.0, 4.1 * rate_mm_h**-0.21, WATER)
    return Sizes(7600.0 * rate_mm_h**-0.87, 2.55 * rate_mm_h**-0.48, ICE)


def extinction(sizes: Sizes, *, halved: bool = False) -> float:
    """Return the extinction alpha, 1/m; with LISA's x if `halved`."""
    number = sizes.density * np.exp(-sizes.rate * _DIAMETERS_MM)
    area = 1e-6 * np.pi / 4.0 * _DIAMETERS_MM**2 * _efficiencies(sizes.refraction, halved)
    return float(np.trapezoid(area * number, _DIAMETERS_MM))


class PaperRain(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        rate_mm_h: R.
        law: law of the drops' sizes.
        echo: reported return, or a model without drops.
        extinction: alpha, 1/m; None for that of the drops.
        halved: extinction is computed as LISA's own Mie code does, see `droplets`.
        range_max_m: r_max, sets p_min.
        range_min_m: r_min, nearest range of drops.
        divergence_rad: full width of the beam.
        smallest_mm: least diameter d0.
        accuracy_m: deviation of the range where the target is half as strong as the weakest detected.
    """

    LEVELS: ClassVar = {"rate_mm_h": (0.2, 0.73, 1.5625, 3.125, 7.29)}
    RANGES: ClassVar = {
        "rate_mm_h": (0.0, 1000.0),
        "extinction": (0.0, 10.0),
        "range_max_m": (1.0, 10_000.0),
        "divergence_rad": (1e-5, 0.1),
        "smallest_mm": (1e-3, 10.0),
        "accuracy_m": (0.0, 10.0),
    }

    rate_mm_h: float = 1.5625
    law: SizeLaw = "marshall_palmer"
    echo: Literal["strongest", "last", "average", "goodin"] = "strongest"
    extinction: float | None = None
    halved: bool = True
    range_max_m: float = 200.0
    range_min_m: float = 1.5
    divergence_rad: float = 0.003
    smallest_mm: float = 0.05
    accuracy_m: float = 0.09

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("PaperRain", "range_min_m", self.range_min_m, 0.0, self.range_max_m)

    @property
    def weakest(self) -> float:
        """Least detected power, p_min."""
        return _WEAKEST / self.range_max_m**2 / (np.pi if self.echo == "goodin" else 1.0)

    @property
    def alpha(self) -> float:
        """Extinction, 1/m."""
        if self.extinction is not None:
            return self.extinction
        return 0.01 * self.rate_mm_h**0.6 if self.echo == "goodin" else extinction(self.sizes, halved=self.halved)

    @property
    def sizes(self) -> Sizes:
        """Law of the drops."""
        return sizes_of(self.law, self.rate_mm_h)


PUBLISHED: dict[str, PaperRain] = {
    "lisa_chu_hogg_fog": PaperRain(echo="average", extinction=3.50e-3),
    "lisa_moderate_advection_fog": PaperRain(echo="average", extinction=3.85e-2),
    "lisa_strong_advection_fog": PaperRain(echo="average", extinction=5.95e-2),
}


class RainyCloud(NamedTuple):
    """A cloud in rain.

    Attributes:
        range_m: (P,) reported range, 0 for lost points.
        intensity: (P,) reported intensity, 0 for lost points.
        label: (P,) `LOST`, `DROP` or `TARGET`.
    """

    range_m: Array
    intensity: Array
    label: NDArray[np.int64]


class Drops(NamedTuple):
    """M drops in P beams, by beam.

    Attributes:
        beam: (M,) row of the beam.
        range_m: (M,).
        diameter_mm: (M,).
        shake: (P,) standard normal numbers for the ranges of targets.
    """

    beam: NDArray[np.int64]
    range_m: Array
    diameter_mm: Array
    shake: Array


Sampler = Callable[[Array, Array, PaperRain, RandomSource], Drops]
"""Sampler of drops: `sampler(reach, power, settings, rng)`, see `draw_drops`."""


def corrupt(sweep: Sweep, settings: PaperRain, rng: RandomSource) -> Sweep:
    """Dim, replace or remove the points; replaced ones are returns of drops."""
    if settings.rate_mm_h == 0.0 or len(sweep) == 0:
        return sweep
    cloud = cloud_of(sweep)
    reach = _reach(cloud)
    out = apply_rain(cloud, settings, rng)
    cloud[:, :3] *= np.divide(out.range_m, reach, out=np.zeros(len(reach)), where=reach > 0)[:, None]
    cloud[:, 3] = out.intensity
    fate = np.where(out.label == DROP, SCATTERED, ATTENUATED)
    return with_cloud(sweep, cloud, fate)[out.label != LOST]


def apply_rain(cloud: Cloud, settings: PaperRain, rng: RandomSource, *, draw: Sampler | None = None) -> RainyCloud:
    """Return the reported range, intensity and label of each point of a cloud.

    Args:
        cloud: (P, 4), intensity of 0 to 1.
        settings: of the rain, at a rate > 0.
        draw: sampler of the drops instead of `draw_drops`.
    """
    settings = replace(settings, extinction=settings.alpha)
    reach, intensity = _reach(cloud), cloud[:, 3].astype(np.float64)
    dimmed = intensity * np.exp(-2.0 * settings.alpha * reach)
    power = np.divide(dimmed, reach**2, out=np.zeros(len(reach)), where=reach > 0)
    if settings.echo in ("average", "goodin"):
        return _without_drops(reach, dimmed, power, settings, rng)
    drops = (draw or draw_drops)(reach, power, settings, rng)
    power_of_drops = drop_power(drops.range_m, drops.diameter_mm, settings)
    row = _chosen(drops, power_of_drops, len(reach), settings)
    found, seen = row >= 0, power >= settings.weakest
    place, echo = np.append(drops.range_m, 0.0)[row], np.append(power_of_drops, 0.0)[row]
    drop = found & (intensity > 0.0) & (echo > power if settings.echo == "strongest" else ~seen)
    deviation = settings.accuracy_m / np.sqrt(2.0 * np.maximum(power, settings.weakest) / settings.weakest)
    return RainyCloud(
        range_m=np.select([drop, seen], [place, reach + deviation * drops.shake], 0.0),
        intensity=np.select([drop, seen], [echo * place**2, dimmed], 0.0),
        label=np.select([drop, seen], [DROP, TARGET], LOST),
    )


def _reach(cloud: Cloud) -> Array:
    return np.linalg.norm(cloud[:, :3].astype(np.float64), axis=1)


def _without_drops(reach: Array, dimmed: Array, power: Array, settings: PaperRain, rng: RandomSource) -> RainyCloud:
    seen = power >= settings.weakest
    range_m = reach.copy()
    if settings.echo == "goodin":
        range_m += 0.02 * reach * (1.0 - np.exp(-settings.rate_mm_h)) ** 2 * rng.normal(size=len(reach))
    return RainyCloud(np.where(seen, range_m, 0.0), np.where(seen, dimmed, 0.0), np.where(seen, TARGET, LOST))


def _chosen(drops: Drops, power: Array, beams: int, settings: PaperRain) -> NDArray[np.int64]:
    """Return (P,) row of each beam's candidate drop, the strongest or the farthest detected one; -1 without one."""
    audible = np.flatnonzero(power >= settings.weakest)
    key = power if settings.echo == "strongest" else drops.range_m
    chosen = np.full(beams, -1)
    order = audible[np.lexsort((key[audible], drops.beam[audible]))]
    last = np.flatnonzero(np.diff(drops.beam[order], append=-1))
    chosen[drops.beam[order[last]]] = order[last]
    return chosen


def drop_power(range_m: Array, diameter_mm: Array, settings: PaperRain) -> Array:
    """Return (M,) received power of drops, pj."""
    share = np.minimum((1e-3 * diameter_mm / (range_m * np.tan(settings.divergence_rad))) ** 2, 1.0)
    return settings.sizes.reflectivity * np.exp(-2.0 * settings.alpha * range_m) * share / range_m**2


def expected_drops(reach: Array, settings: PaperRain) -> Array:
    """Return (P,) mean number of drops in cones of these lengths, m."""
    volume = np.pi / 3.0 * reach * (0.5 * reach * np.tan(settings.divergence_rad)) ** 2
    return settings.sizes.number(settings.smallest_mm) * volume


def draw_drops(reach: Array, power: Array, settings: PaperRain, rng: RandomSource) -> Drops:
    """Draw the drops near enough to be detected, all beams at once.

    Args:
        reach: (P,) range of the targets, m.
        power: (P,) received power of the targets.
    """
    sizes = settings.sizes
    largest_m = 1e-3 * (settings.smallest_mm + _RARE / sizes.rate)
    audible_m = np.sqrt(largest_m / np.tan(settings.divergence_rad) * np.sqrt(sizes.reflectivity / settings.weakest))
    near = np.minimum(reach, audible_m)
    expected = expected_drops(reach, settings)
    number = np.floor(expected) + (rng.random(len(reach)) < expected % 1.0)
    share = np.divide(near, reach, out=np.zeros(len(reach)), where=reach > 0) ** 3
    beam = np.repeat(np.arange(len(reach)), rng.binomial(number.astype(np.int64), share))
    range_m = near[beam] * np.cbrt(rng.random(len(beam)))
    diameter_mm = settings.smallest_mm - np.log1p(-rng.random(len(beam))) / sizes.rate
    seen = range_m > settings.range_min_m
    return Drops(beam[seen], range_m[seen], diameter_mm[seen], rng.normal(size=len(reach)))


def efficiency(size: Array, index: float) -> Array:
    """Return the extinction efficiency Q of a sphere.

    Args:
        size: (N,) circumference over wavelength, more than 0.
    """
    q = 2.0 + _EDGE * np.maximum(size, 1.0) ** (-2.0 / 3.0)
    small = size <= _LARGEST_SERIES
    if small.any():
        q[small] = _mie(size[small], index)
    return q


@lru_cache(maxsize=4)
def _efficiencies(index: float, halved: bool) -> Array:
    return efficiency(np.pi * _DIAMETERS_MM / _WAVELENGTH_MM * (0.5 if halved else 1.0), index)


def _mie(x: Array, m: float) -> Array:
    """Return the sum of 2 / x^2 (2 n + 1) Re(a_n + b_n) over n (Bohren and Huffman 1983, 4.53 and 4.62)."""
    # SciPy takes half a second to import, which most users of the registry need not wait for.
    from scipy.special import spherical_jn, spherical_yn

    terms = np.ceil(x + 4.05 * np.cbrt(x) + 2.0)
    n = np.arange(1.0, terms.max() + 1.0)[:, None]
    with np.errstate(invalid="ignore", over="ignore"):  # unused terms overflow
        psi, d_psi = _riccati(spherical_jn(n, x), spherical_jn(n, x, derivative=True), x)
        chi, d_chi = _riccati(spherical_yn(n, x), spherical_yn(n, x, derivative=True), x)
        within, d_within = _riccati(spherical_jn(n, m * x), spherical_jn(n, m * x, derivative=True), m * x)
        xi, d_xi = psi + 1j * chi, d_psi + 1j * d_chi
        a = (m * within * d_psi - psi * d_within) / (m * within * d_xi - xi * d_within)
        b = (within * d_psi - m * psi * d_within) / (within * d_xi - m * xi * d_within)
    return 2.0 / x**2 * np.where(n <= terms, (2.0 * n + 1.0) * (a + b).real, 0.0).sum(axis=0)


def _riccati(value: Array, slope: Array, x: Array) -> tuple[Array, Array]:
    """Return x z(x) and its derivative, for z and its derivative."""
    return x * value, value + x * slope
