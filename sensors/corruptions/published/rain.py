"""Rain and snow of LISA (Kilic et al. 2021), as 3D_Corruptions_AD uses it too.

A beam of 3 mrad is a cone of volume V = pi / 3 r (r tan(3 mrad) / 2)^2 with n = N V drops larger than d0 = 0.05 mm in
it (`droplets`), rounded up or down at random. Each is at r U^(1/3), if that is more than r_min, and has the diameter
D = d0 - ln(1 - U) / rate. Target and drops answer with

    p0 = i exp(-2 alpha r) / r^2          pj = F exp(-2 alpha rj) min((D / (rj tan(3 mrad)))^2, 1) / rj^2

and p_min = 0.9 / r_max^2 is the weakest that is detected. `strongest`: the point is lost if all are weaker; if a drop
is the strongest, the point is there, with intensity pj rj^2; else it is at r + N(0, 0.09 / sqrt(2 p0 / p_min)) with
i exp(-2 alpha r). `last`: the target, if p0 > p_min, else the farthest drop above p_min, else lost.

| severity     | 1   | 2    | 3      | 4     | 5    |
|--------------|-----|------|--------|-------|------|
| rate, mm/h   | 0.2 | 0.73 | 1.5625 | 3.125 | 7.29 |

Rates are those of 3D_Corruptions_AD; DSRC and Robo3D have no rain. LISA's r_max and r_min are 200 and 1.5 m, those of
3D_Corruptions_AD 120 and 0.9 m. Two models without drops: `average` dims only, for fogs and sprays of a given
extinction; `goodin` (Goodin et al. 2019) has alpha = 0.01 R^0.6, a deviation of the range of
0.02 r (1 - exp(-R))^2, and p_min = 0.9 / (pi r_max^2).

Quirks: points of intensity 0 are lost without a draw. The published code loops over the points (`in_turn`), which for a
legacy generator gives what it gives. By default only drops so near that one of them could be detected are drawn, whose
number is binomial: the outcome has the same law, far faster. Lost points, at the origin in LISA, leave the sweep.
"""

from typing import Literal, NamedTuple, Self

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import at_level, check_range
from sensors.corruptions.published.cloud import Cloud, Draws, cloud_of, with_cloud
from sensors.corruptions.published.droplets import SizeLaw, Sizes, extinction, sizes_of
from sensors.sweep import ATTENUATED, SCATTERED, Sweep

RATE_MM_H = (0.2, 0.73, 1.5625, 3.125, 7.29)

LOST, DROP, TARGET = range(3)
"""Values of `Rained.label`, as in LISA."""

_WEAKEST = 0.9
_RARE = 35.0

Array = NDArray[np.float64]


class Rain(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        rate_mm_h: R.
        law: of the drops' sizes.
        echo: which return is reported, or a model without drops.
        extinction: alpha, 1/m; None computes it from the drops.
        halved: extinction is computed as LISA's own Mie code does, see `droplets`.
        range_max_m: r_max, which sets p_min.
        range_min_m: r_min, no drop is seen nearer.
        divergence_rad: full width of the beam.
        smallest_mm: d0.
        accuracy_m: deviation of the range where the target is half as strong as the weakest detected.
    """

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
        check_range("Rain", "rate_mm_h", self.rate_mm_h, 0.0, 1000.0)
        check_range("Rain", "extinction", self.extinction or 0.0, 0.0, 10.0)
        check_range("Rain", "range_max_m", self.range_max_m, 1.0, 10_000.0)
        check_range("Rain", "range_min_m", self.range_min_m, 0.0, self.range_max_m)
        check_range("Rain", "divergence_rad", self.divergence_rad, 1e-5, 0.1)
        check_range("Rain", "smallest_mm", self.smallest_mm, 1e-3, 10.0)
        check_range("Rain", "accuracy_m", self.accuracy_m, 0.0, 10.0)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(rate_mm_h=at_level(RATE_MM_H, level))

    @property
    def weakest(self) -> float:
        """p_min."""
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


_NUSCENES = Rain(range_max_m=120.0, range_min_m=0.9)

PUBLISHED: dict[str, Rain] = {
    **{f"3d_corruptions_ad_rain_{k}": replace(_NUSCENES, rate_mm_h=r) for k, r in enumerate(RATE_MM_H, 1)},
    **{
        f"3d_corruptions_ad_snow_{k}": replace(_NUSCENES, rate_mm_h=r, law="gunn_marshall")
        for k, r in enumerate(RATE_MM_H, 1)
    },
    "lisa_chu_hogg_fog": Rain(echo="average", extinction=3.50e-3),
    "lisa_moderate_advection_fog": Rain(echo="average", extinction=3.85e-2),
    "lisa_strong_advection_fog": Rain(echo="average", extinction=5.95e-2),
    "lisa_moderate_spray": Rain(echo="average", extinction=8.98e-3),
    "lisa_strong_spray": Rain(echo="average", extinction=3.42e-2),
}


class Rained(NamedTuple):
    """A cloud in rain.

    Attributes:
        range_m: (P,) of what is reported, 0 where it is lost.
        intensity: (P,) of it, 0 where it is lost.
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


def corrupt(sweep: Sweep, severity: int | Rain, rng: Draws) -> Sweep:
    """Dim, replace or lose the points; what is replaced is a return of a drop."""
    settings = severity if isinstance(severity, Rain) else Rain.severity(severity)
    if settings.rate_mm_h == 0.0 or len(sweep) == 0:
        return sweep
    cloud = cloud_of(sweep)
    reach = _reach(cloud)
    out = rained(cloud, settings, rng)
    cloud[:, :3] *= np.divide(out.range_m, reach, out=np.zeros(len(reach)), where=reach > 0)[:, None]
    cloud[:, 3] = out.intensity
    fate = np.where(out.label == DROP, SCATTERED, ATTENUATED)
    return with_cloud(sweep, cloud, fate)[out.label != LOST]


def rained(cloud: Cloud, settings: Rain, rng: Draws, *, in_turn: bool = False) -> Rained:
    """Return what the sensor reports for each point of a cloud.

    Args:
        cloud: (P, 4), intensity of 0 to 1.
        settings: of the rain, at a rate > 0.
        rng: the only randomness.
        in_turn: draw point by point, as LISA does: a number to round n, n ranges, diameters of the drops beyond r_min,
            and a normal number if the target is reported.
    """
    settings = replace(settings, extinction=settings.alpha)
    reach, intensity = _reach(cloud), cloud[:, 3].astype(np.float64)
    dimmed = intensity * np.exp(-2.0 * settings.alpha * reach)
    power = np.divide(dimmed, reach**2, out=np.zeros(len(reach)), where=reach > 0)
    if settings.echo in ("average", "goodin"):
        return _without_drops(reach, dimmed, power, settings, rng)
    drops = (_drops_in_turn if in_turn else _drops)(reach, power, settings, rng)
    drop_power = _drop_power(drops.range_m, drops.diameter_mm, settings)
    row = _chosen(drops, drop_power, len(reach), settings)
    found, seen = row >= 0, power >= settings.weakest
    place, echo = np.append(drops.range_m, 0.0)[row], np.append(drop_power, 0.0)[row]
    drop = found & (intensity > 0.0) & (echo > power if settings.echo == "strongest" else ~seen)
    deviation = settings.accuracy_m / np.sqrt(2.0 * np.maximum(power, settings.weakest) / settings.weakest)
    return Rained(
        range_m=np.select([drop, seen], [place, reach + deviation * drops.shake], 0.0),
        intensity=np.select([drop, seen], [echo * place**2, dimmed], 0.0),
        label=np.select([drop, seen], [DROP, TARGET], LOST),
    )


def _reach(cloud: Cloud) -> Array:
    return np.linalg.norm(cloud[:, :3].astype(np.float64), axis=1)


def _without_drops(reach: Array, dimmed: Array, power: Array, settings: Rain, rng: Draws) -> Rained:
    seen = power >= settings.weakest
    range_m = reach.copy()
    if settings.echo == "goodin":
        range_m += 0.02 * reach * (1.0 - np.exp(-settings.rate_mm_h)) ** 2 * rng.normal(size=len(reach))
    return Rained(np.where(seen, range_m, 0.0), np.where(seen, dimmed, 0.0), np.where(seen, TARGET, LOST))


def _chosen(drops: Drops, power: Array, beams: int, settings: Rain) -> NDArray[np.int64]:
    """Return (P,) row of the drop that each beam could report, the loudest or the farthest audible one; -1 for none."""
    audible = np.flatnonzero(power >= settings.weakest)
    key = power if settings.echo == "strongest" else drops.range_m
    chosen = np.full(beams, -1)
    order = audible[np.lexsort((key[audible], drops.beam[audible]))]
    last = np.flatnonzero(np.diff(drops.beam[order], append=-1))
    chosen[drops.beam[order[last]]] = order[last]
    return chosen


def _drop_power(range_m: Array, diameter_mm: Array, settings: Rain) -> Array:
    """Return pj."""
    share = np.minimum((1e-3 * diameter_mm / (range_m * np.tan(settings.divergence_rad))) ** 2, 1.0)
    return settings.sizes.reflectivity * np.exp(-2.0 * settings.alpha * range_m) * share / range_m**2


def _expected(reach: Array, settings: Rain) -> Array:
    """Return the number of drops in cones of these lengths."""
    volume = np.pi / 3.0 * reach * (0.5 * reach * np.tan(settings.divergence_rad)) ** 2
    return settings.sizes.number(settings.smallest_mm) * volume


def _drops(reach: Array, power: Array, settings: Rain, rng: Draws) -> Drops:
    """Draw the drops that could be detected, all beams at once."""
    sizes = settings.sizes
    largest_m = 1e-3 * (settings.smallest_mm + _RARE / sizes.rate)
    audible_m = np.sqrt(largest_m / np.tan(settings.divergence_rad) * np.sqrt(sizes.reflectivity / settings.weakest))
    near = np.minimum(reach, audible_m)
    expected = _expected(reach, settings)
    number = np.floor(expected) + (rng.random(len(reach)) < expected % 1.0)
    share = np.divide(near, reach, out=np.zeros(len(reach)), where=reach > 0) ** 3
    beam = np.repeat(np.arange(len(reach)), rng.binomial(number.astype(np.int64), share))
    range_m = near[beam] * np.cbrt(rng.random(len(beam)))
    diameter_mm = settings.smallest_mm - np.log1p(-rng.random(len(beam))) / sizes.rate
    seen = range_m > settings.range_min_m
    return Drops(beam[seen], range_m[seen], diameter_mm[seen], rng.normal(size=len(reach)))


def _drops_in_turn(reach: Array, power: Array, settings: Rain, rng: Draws) -> Drops:
    """Draw the drops of one beam after the other."""
    sizes, expected = settings.sizes, _expected(reach, settings)
    shake = np.zeros(len(reach))
    ranges, diameters = [], []
    for row in range(len(reach)):
        if power[row] <= 0.0:
            ranges.append(np.zeros(0))
            diameters.append(np.zeros(0))
            continue
        number = int(expected[row]) + (rng.random() < expected[row] - int(expected[row]))
        range_m = reach[row] * rng.random(number) ** (1.0 / 3.0)
        range_m = range_m[range_m > settings.range_min_m]
        diameter_mm = settings.smallest_mm - np.log(1.0 - rng.random(len(range_m))) / sizes.rate
        reported = power[row] >= settings.weakest
        if settings.echo == "strongest":
            reported &= power[row] >= _drop_power(range_m, diameter_mm, settings).max(initial=0.0)
        shake[row] = rng.normal() if reported else 0.0
        ranges.append(range_m)
        diameters.append(diameter_mm)
    beam = np.repeat(np.arange(len(reach)), [len(r) for r in ranges])
    return Drops(beam, np.concatenate(ranges or [np.zeros(0)]), np.concatenate(diameters or [np.zeros(0)]), shake)
