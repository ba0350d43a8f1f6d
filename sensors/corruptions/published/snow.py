"""Snow of Hahner et al. (CVPR 2022), as DSRC and Robo3D use it.

Every channel has a plane of its own with its own flakes (`snow_discs`), which take shares of the beams (`snow_beams`).
In a beam with flakes all have echoes, the target last, on bins R of 0.1 m from ceil(10 r) to floor(10 (r + c tau)):

    P(R) = C_A P0 beta0 share xi(r) / r^2 sin^2(pi (R - r) / (c tau)),   tau = 10 ns

with C_A P0 beta0 of a flake 0.9 i_max, and of the target i' r^2, where i' = i - f(r) is its intensity (of 0 to 255)
less what the HDL-64E's focus adds, f(r) = 255 slope |offset - (1 - r / 120)^2|, in [0, i_max]. The strongest bin wins:
range d = bin / 10 - c tau / 2, intensity P + f(d), cut to an integer. If d is within 0.2 m of the target its point
keeps its place (label 1), else it moves along its ray to d (label 2); beams without flakes have label 0. Then all
points that did not move and whose rounded intensity is at most a noise floor, a parabola over range (`ground`), are
removed.

| severity              | 1     | 2    | 3 (DSRC, Robo3D light) | 4 (moderate) | 5 (heavy) |
|-----------------------|-------|------|------------------------|--------------|-----------|
| snowfall, mm/h        | 0.125 | 0.25 | 0.5                    | 1.0          | 2.5       |
| fall speed, m/s       | 2.0   | 2.0  | 2.0                    | 1.6          | 1.6       |

With severity the share of moved points grows; more snow touches and removes fewer points, as it has fewer and larger
flakes.

Quirks, as switches:

* In the released code, all three, the target takes over C_A P0 of the flake before it, so that its own intensity does
  not matter; `own_power` repairs that.
* DSRC stops a bin earlier (`last_bin` is Hahner's and Robo3D's way), and its darkest intensity is 0, not the
  calibration's (`darkest`).
* Bins lie at round(k (120 + c tau) / 1229, 2) m in the pulse and at k / 10 m in d.
* Channels are guessed by elevation (`rings`), 0 on top, and get the optics of the HDL-64E's laser of that number; i_max
  is 255, but 230 for channels 53, 55, 56 and 58.
* `calibration` names an npz file with the HDL-64E's focus (`read_calibration`); it is not part of this package. Without
  one f = 0 and the darkest is 0.
* `noise_factor` of None leaves the noise floor out. On intensities like CARLA's, exp(-0.004 r), it removes most points
  and all nearer than 10 m, without any snow.
* Beams across azimuth 0, see `snow_beams`.
* A flake nearer than 0.9 m is before the receiver's view. One that takes a whole beam there, in heavy snow 3 to 10 of
  13,000 beams, leaves it without any echo, and the strongest bin is then the first: the point moves to d = -c tau / 2,
  1.5 m away on the other side of the sensor.

Without the calibration the model is another one, and `corrupt` warns: touched points miss what the focus adds, and more
of them fall below the noise floor. The published street of 64 rings then loses 22 / 18 / 14 % of its points in the
three snows, with it 5 / 4 / 3 %. Bins continue beyond 120 m, where the release fails.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.corruptions.physics.receiver import overlap
from sensors.corruptions.published.cloud import Cloud, RandomSource, cloud_of, with_cloud
from sensors.corruptions.published.echo import pulse
from sensors.corruptions.published.ground import fit_plane, ground_of, noise_floor, noise_line
from sensors.corruptions.published.rings import LASERS, RingSource, rings_from
from sensors.corruptions.published.snow_beams import Shares, shares_of
from sensors.corruptions.published.snow_discs import DISCS, Law, disc_sample
from sensors.optics.reflectance import LIGHT_SPEED
from sensors.sweep import ATTENUATED, KEPT, SCATTERED, Sweep
from sim.errors import DataError, complaint, notice
from sim.geometry import Array
from sim.packed import read_arrays
from sim.reading import parsing

UNTOUCHED, DIMMED, MOVED = range(3)
"""Values of `SnowyCloud.label`."""

PULSE_S = 1e-8
SCALE = 255.0
"""Model intensity of 1 in a sweep."""

_PULSE_M = LIGHT_SPEED * PULSE_S
_REACH_M, _BINS = 120.0, 1230
_FLAKE = 0.9
_SAME_M = 0.2
_WEAK_LASERS, _WEAK = (53, 55, 56, 58), 230.0
_CELLS = 4_000_000
_UNCALIBRATED = (
    "snow, paper: expected PaperSnow.calibration, an npz file of the HDL-64E's focus, found none: about 22 % of the "
    "points are lost where the release, which has it, loses 5 % (`dsrc corrupt ... --set calibration=FILE`)"
)


class PaperSnow(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`; see above for the switches.

    Attributes:
        snowfall_mm_h: snowfall s.
        fall_speed_mps: fall speed v.
        law: law of the flakes' sizes.
        divergence_rad: full width of a beam.
        own_power: the target returns its own intensity.
        last_bin: echoes reach to their last bin.
        darkest: intensities are at least those of the calibration.
        noise_factor: of the noise line; None for no noise floor.
        calibration: npz file of the HDL-64E's focus.
        rings: source of the channels.
    """

    LEVELS: ClassVar = {"snowfall_mm_h": (0.125, 0.25, 0.5, 1.0, 2.5), "fall_speed_mps": (2.0, 2.0, 2.0, 1.6, 1.6)}
    RANGES: ClassVar = {
        "snowfall_mm_h": (0.0, 50.0),
        "fall_speed_mps": (0.1, 10.0),
        "divergence_rad": (1e-5, 0.1),
        "noise_factor": (0.0, 10.0),
    }

    snowfall_mm_h: float = 0.5
    fall_speed_mps: float = 2.0
    law: Law = "gunn"
    divergence_rad: float = 0.003
    own_power: bool = False
    last_bin: bool = False
    darkest: bool = False
    noise_factor: float | None = 0.7
    calibration: str | None = None
    rings: RingSource = "elevation"


PUBLISHED: dict[str, PaperSnow] = {
    "dsrc": PaperSnow(),
    "robo3d_light": PaperSnow(last_bin=True, darkest=True),
    "robo3d_moderate": PaperSnow(snowfall_mm_h=1.0, fall_speed_mps=1.6, last_bin=True, darkest=True),
    "robo3d_heavy": PaperSnow(snowfall_mm_h=2.5, fall_speed_mps=1.6, last_bin=True, darkest=True),
    "multicorrupt_1": PaperSnow(snowfall_mm_h=0.5, fall_speed_mps=1.2, last_bin=True, rings="sweep"),
    "multicorrupt_2": PaperSnow(snowfall_mm_h=2.5, fall_speed_mps=1.6, last_bin=True, rings="sweep"),
    "multicorrupt_3": PaperSnow(snowfall_mm_h=1.5, fall_speed_mps=0.4, last_bin=True, rings="sweep"),
}


class Calibration(NamedTuple):
    """Optics of 64 lasers.

    Attributes:
        slope: (64,) of the focus.
        offset: (64,) of the focus.
        darkest: (64,) least intensity.
    """

    slope: Array
    offset: Array
    darkest: Array

    def focus(self, channel: NDArray[np.integer], range_m: Array) -> Array:
        """Return (N,) addition of the focus to intensities, as a share of the largest."""
        return self.slope[channel] * np.abs(self.offset[channel] - (1.0 - range_m / _REACH_M) ** 2)


class SnowyCloud(NamedTuple):
    """A cloud in snow.

    Attributes:
        cloud: (P, 4 or more) float64, all points of the input; intensity of 0 to 255, rounded.
        label: (P,) `UNTOUCHED`, `DIMMED` or `MOVED`.
        kept: (P,) mask of points above the noise floor.
    """

    cloud: Array
    label: NDArray[np.int64]
    kept: NDArray[np.bool_]


def corrupt(sweep: Sweep, settings: PaperSnow, rng: RandomSource) -> Sweep:
    """Dim, move or remove the points; moved ones are returns of flakes.

    Raises:
        DataError: the calibration file is missing or wrong, or rings are missing and cannot be estimated.
    """
    if settings.snowfall_mm_h == 0.0 or len(sweep) == 0:
        return sweep
    if settings.calibration is None and settings.noise_factor is not None:
        notice(_UNCALIBRATED)
    channel, _ = rings_from(sweep, settings.rings, "snow")
    order = rng.permutation(DISCS)
    cloud = cloud_of(sweep)
    cloud[:, 3] *= SCALE
    snow = (settings.snowfall_mm_h, settings.fall_speed_mps, settings.law)
    out = apply_snow(cloud, channel % LASERS, lambda c: disc_sample(*snow, int(order[c])), settings, rng)
    out.cloud[:, 3] /= SCALE
    return with_cloud(sweep, out.cloud, np.array([KEPT, ATTENUATED, SCATTERED])[out.label])[out.kept]


def apply_snow(
    cloud: Cloud,
    channel: NDArray[np.integer],
    discs: Callable[[int], Array] | Sequence[Array],
    settings: PaperSnow,
    rng: RandomSource | None = None,
    *,
    floor: Array | None = None,
) -> SnowyCloud:
    """Return a cloud in snow.

    Args:
        cloud: (P, 4), intensity of 0 to 255.
        channel: (P,) in [0, 64).
        discs: flakes of each channel, by `discs(channel)` or as a sequence: (F, 3) x, y, radius, m.
        settings: of the snow; its amount is in the discs.
        rng: for the ground plane, if needed.
        floor: (3,) parabola of the noise floor, highest power first, instead of the cloud's own.
    """
    before = cloud.astype(np.float64)
    reach = np.sqrt((before[:, :3] ** 2).sum(axis=1))
    shares = _all_shares(before, reach, channel, discs, settings)
    place, intensity = _strongest(before[:, 3], reach, channel, shares, settings)
    heard = np.isfinite(place)
    label = np.where(heard, np.where(np.abs(place - reach) < _SAME_M, DIMMED, MOVED), UNTOUCHED)
    out, moved = before.copy(), label == MOVED
    out[moved, :3] *= (place[moved] / reach[moved])[:, None]
    out[heard, 3] = intensity[heard]
    out[:, 3] = np.round(out[:, 3])
    if floor is None:
        floor = _floor(before, settings, rng)
    kept = moved | (out[:, 3] > np.polyval(floor, reach)) if floor is not None else np.ones(len(out), bool)
    return SnowyCloud(out, label, kept)


@lru_cache(maxsize=4)
def read_calibration(path: str) -> Calibration:
    """Read the focus of an HDL-64E.

    Args:
        path: npz file with `focal_distance_m`, `focal_slope` and `min_intensity`, (64,) each.

    Raises:
        DataError: the file is missing or not a calibration.
    """
    data = read_arrays(Path(path), "calibration of an HDL-64E's focus")
    with parsing(path, "calibration of an HDL-64E's focus"):
        distance, slope, darkest = (
            np.asarray(data[name], np.float64) for name in ("focal_distance_m", "focal_slope", "min_intensity")
        )
    if not distance.shape == slope.shape == darkest.shape == (LASERS,):
        raise DataError(complaint(path, "focal_slope", f"{LASERS} lasers", f"shape {slope.shape}"))
    return Calibration(slope, (1.0 - 100.0 * distance / 13100.0) ** 2, darkest)


def _all_shares(
    cloud: Array,
    reach: Array,
    channel: NDArray[np.integer],
    discs: Callable[[int], Array] | Sequence[Array],
    settings: PaperSnow,
) -> Shares:
    """Return the shares of flakes in all beams, each channel with its own flakes."""
    azimuth = np.arctan2(cloud[:, 1], cloud[:, 0])
    target = np.ones(len(cloud))
    parts = []
    for c in np.unique(channel).tolist():
        rows = np.flatnonzero(channel == c)
        flakes = discs(c) if callable(discs) else discs[c]
        found = shares_of(azimuth[rows], reach[rows], flakes, settings.divergence_rad)
        target[rows] = found.target
        parts.append(found._replace(beam=rows[found.beam]))
    beam = np.concatenate([p.beam for p in parts] or [np.zeros(0, np.int64)])
    range_m, share = (
        np.concatenate([getattr(p, name) for p in parts] or [np.zeros(0)]) for name in ("range_m", "share")
    )
    return Shares(beam, range_m, share, target)


def _strongest(
    intensity: Array, reach: Array, channel: NDArray[np.integer], shares: Shares, settings: PaperSnow
) -> tuple[Array, Array]:
    """Return (P,) range along the ray and intensity of the strongest bin in beams with flakes; NaN for all others."""
    known = settings.calibration
    optics = Calibration(*np.zeros((3, LASERS))) if known is None else read_calibration(known)
    brightest = np.where(np.isin(channel, _WEAK_LASERS), _WEAK, SCALE)
    hit, flake = np.unique(shares.beam, return_inverse=True)
    far = reach[hit]
    if settings.own_power:
        focus = SCALE * optics.focus(channel[hit], far)
        target = np.clip(intensity[hit] - focus, 0.0, brightest[hit]) * shares.target[hit] * overlap(far)
    else:
        target = _FLAKE * brightest[hit] * shares.target[hit] * overlap(far) / np.maximum(far, 1e-6) ** 2
    flakes = _FLAKE * brightest[shares.beam] * shares.share * overlap(shares.range_m) / shares.range_m**2
    beam = np.concatenate([flake, np.arange(len(hit))])
    power, peak_bin = _peaks(
        beam, np.concatenate([shares.range_m, far]), np.concatenate([flakes, target]), settings.last_bin
    )
    d = peak_bin / 10.0 - 0.5 * _PULSE_M
    bright = power + brightest[hit] * optics.focus(channel[hit], d)
    place, level = np.full((2, len(reach)), np.nan)
    place[hit] = d
    level[hit] = np.trunc(np.clip(bright, optics.darkest[channel[hit]] if settings.darkest else 0.0, brightest[hit]))
    return place, level


def _peaks(
    beam: NDArray[np.int64], range_m: Array, amplitude: Array, last_bin: bool
) -> tuple[Array, NDArray[np.int64]]:
    """Return power and index of the strongest bin of each beam, in which all its echoes add up.

    Args:
        beam: (N,) of each echo, every one of [0, H) at least once.
        range_m: (N,) of its source, m.
        amplitude: (N,) of its echo.
        last_bin: echoes reach to their last bin.

    Returns:
        (H,) peak and bin.
    """
    beams = int(beam.max()) + 1 if len(beam) else 0
    power, peak_bin = np.zeros(beams), np.zeros(beams, np.int64)
    first = np.ceil(10.0 * range_m).astype(np.int64)
    after = np.floor(10.0 * (range_m + _PULSE_M)).astype(np.int64) + last_bin
    sounding = amplitude > 0.0
    beam, first, after = beam[sounding], first[sounding], after[sounding]
    range_m, amplitude = range_m[sounding], amplitude[sounding]
    longest = int((after - first).max(initial=0))
    bins = int(after.max(initial=0)) + 1
    bin_m = np.round(np.arange(bins) * ((_REACH_M + _PULSE_M) / (_BINS - 1)), 2)
    order = np.argsort(beam, kind="stable")
    edges = np.searchsorted(beam[order], np.arange(beams + 1))
    lines = max(1, _CELLS // bins)
    for low in range(0, beams, lines):
        rows = order[edges[low] : edges[min(low + lines, beams)]]
        k = first[rows, None] + np.arange(longest)
        echo = amplitude[rows, None] * pulse(bin_m[np.minimum(k, bins - 1)] - range_m[rows, None], PULSE_S)
        echo[k >= after[rows, None]] = 0.0
        cell = (beam[rows, None] - low) * bins + np.minimum(k, bins - 1)
        number = min(lines, beams - low)
        total = np.bincount(cell.ravel(), echo.ravel(), number * bins).reshape(number, bins)
        peak_bin[low : low + number] = total.argmax(axis=1)
        power[low : low + number] = total.max(axis=1)
    return power, peak_bin


def _floor(cloud: Array, settings: PaperSnow, rng: RandomSource | None) -> Array | None:
    """Return the parabola of the noise floor; None without one or with too little ground."""
    if settings.noise_factor is None:
        return None
    if rng is None:
        raise ValueError("apply_snow needs a floor, or a generator to find one with")
    ground = ground_of(cloud, fit_plane(cloud, rng))
    line = noise_line(ground, cloud[ground.rows, 3])
    return None if line is None else noise_floor(ground, line, settings.noise_factor)
