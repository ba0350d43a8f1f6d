"""Fog of Hahner et al. (ICCV 2021), as DSRC and Robo3D use it.

A target of intensity i at range r competes with the fog before it (`echo`), point by point:

    hard = i exp(-2 alpha r)        soft = I(r) i r^2 beta / beta0

with I(r) and the range d(r) of the strongest echo of the fog from a table over r in steps of 0.1 m up to 200 m. Where
soft > hard the point moves along its ray to d and gets the intensity soft, else it keeps its place and gets hard. No
point is ever lost, and which points move does not depend on i: all beyond one range.

| severity                             | 1     | 2     | 3 (DSRC, Robo3D light) | 4 (moderate) | 5 (heavy) |
|--------------------------------------|-------|-------|------------------------|--------------|-----------|
| beta, 1/(m sr)                       | 0.002 | 0.004 | 0.008                  | 0.05         | 0.2       |
| moves beyond, m, with alpha = 0.06/m | 31    | 28    | 24                     | 16           | 11        |

alpha is drawn for every sweep from 0, 0.005, 0.01, 0.02, 0.03, 0.06 per m, as in DSRC and Robo3D: the agents of a scene
are in different fogs, one in six in clear air. Hahner sets alpha instead, 0.005
to 0.06 (to 0.2) per m, and beta should follow as 0.046 / (ln 20 / alpha), `backscatter_of`; in the published batch
script it stays at that of alpha = 0.06, `BACKSCATTER_FIXED`.

Quirks, as switches where they are choices: the table puts the peak half a pulse, 3.0 m, too far, and is the same beyond
4.8 m, so that all fog is 4.5 to 4.7 m away; `noise` then spreads it by a random factor on the moved point, drawn for
one after the other:

    v1  r / U(r - n, r + n)              v2  max(1, n / 5)^U(-1, 1)
    v3  max(1, 0.4 n)^U(-0.5, 1)         v4  (d + 10 Beta(2, 20)) / d

v1 throws points far behind their target, or through the origin, where r is near n or less. On intensities of 0 to 255
Hahner rounds hard and caps soft at 255 (`scale`, `rounded`, `cap`), which on 0 to 1 turns nearly everything to fog.
`gain` makes the brightest point 255 (Hahner's viewer). Published tables exist for a few
alpha and one pulse, others are snapped to them; here every alpha has its own, computed in a moment and kept on disk.
"""

from functools import lru_cache
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.corruptions.physics.table_cache import cached_tables
from sensors.corruptions.published.cloud import Cloud, RandomSource, cloud_of, with_cloud
from sensors.corruptions.published.echo import TARGET_BACKSCATTER, soft_integral
from sensors.sweep import ATTENUATED, SCATTERED, Sweep

EXTINCTIONS = (0.0, 0.005, 0.01, 0.02, 0.03, 0.06)
"""Extinctions that DSRC and Robo3D draw from, 1/m."""

PULSE_S = 2e-8
"""tau."""

_REACH_M, _ROWS, _STEP_M = 200.0, 2000, 0.1
_TABLE_VERSION = 1


def backscatter_of(extinction: float) -> float:
    """Return beta of fog of an extinction, 1/(m sr): 0.046 over the visibility ln 20 / alpha."""
    return 0.046 * extinction / float(np.log(20.0))


BACKSCATTER_FIXED = backscatter_of(0.06)
"""beta of the published batch script whatever the extinction, 9.2131e-4."""


class PaperFog(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        extinction: alpha, 1/m; None draws one of `EXTINCTIONS`.
        backscatter: beta, 1/(m sr).
        pulse_s: tau.
        noise: n, m; 0 for none.
        variant: of the noise.
        scale: model intensity of 1 in a sweep.
        rounded: hard intensities are rounded to integers.
        cap: soft intensities are at most this.
        gain: intensities are times 255 / the largest, rounded up.
    """

    LEVELS: ClassVar = {"backscatter": (0.002, 0.004, 0.008, 0.05, 0.2)}
    RANGES: ClassVar = {
        "extinction": (0.0, 10.0),
        "backscatter": (0.0, 10.0),
        "pulse_s": (1e-10, 1e-6),
        "noise": (0.0, 100.0),
        "scale": (1e-3, 1e6),
    }

    extinction: float | None = None
    backscatter: float = 0.008
    pulse_s: float = PULSE_S
    noise: float = 10.0
    variant: Literal["v1", "v2", "v3", "v4"] = "v1"
    scale: float = 1.0
    rounded: bool = False
    cap: float | None = None
    gain: bool = False


def hahner(extinction: float, *, coupled: bool = False) -> PaperFog:
    """Return Hahner's settings: intensities of 0 to 255, and beta fixed unless `coupled` to alpha."""
    beta = backscatter_of(extinction) if coupled else BACKSCATTER_FIXED
    return PaperFog(extinction=extinction, backscatter=beta, scale=255.0, rounded=True, cap=255.0)


PUBLISHED: dict[str, PaperFog] = {
    "dsrc": PaperFog(),
    "robo3d_light": PaperFog(backscatter=0.008),
    "robo3d_moderate": PaperFog(backscatter=0.05),
    "robo3d_heavy": PaperFog(backscatter=0.2),
    "multicorrupt_1": PaperFog(extinction=0.02, backscatter=0.008, scale=255.0, rounded=True),
    "multicorrupt_2": PaperFog(extinction=0.03, backscatter=0.008, scale=255.0, rounded=True),
    "multicorrupt_3": PaperFog(extinction=0.06, backscatter=0.05, scale=255.0, rounded=True),
    **{f"hahner_{alpha:g}": hahner(alpha) for alpha in (0.005, 0.01, 0.02, 0.03, 0.06, 0.1, 0.12, 0.15, 0.2)},
}


class FogTable(NamedTuple):
    """Strongest echo of the fog before targets at 0, 0.1, ... 200 m.

    Attributes:
        range_m: (2001,) d, 0 where there is no echo.
        integral: (2001,) I, s/m^2.
    """

    range_m: NDArray[np.float64]
    integral: NDArray[np.float64]


class FoggyCloud(NamedTuple):
    """A cloud in fog.

    Attributes:
        cloud: (P, 4 or more) float64.
        moved: (P,) mask of the fog's returns.
    """

    cloud: NDArray[np.float64]
    moved: NDArray[np.bool_]


def corrupt(sweep: Sweep, fog: PaperFog, rng: RandomSource) -> Sweep:
    """Dim or move every point; moved points are returns of the fog."""
    if fog.extinction == fog.backscatter == 0.0 or len(sweep) == 0:
        return sweep
    cloud = cloud_of(sweep)
    cloud[:, 3] *= fog.scale
    out, moved = apply_fog(cloud, fog, rng)
    out[:, 3] /= 255.0 if fog.gain else fog.scale
    return with_cloud(sweep, out, np.where(moved, SCATTERED, ATTENUATED))


def apply_fog(cloud: Cloud, fog: PaperFog, rng: RandomSource) -> FoggyCloud:
    """Return a cloud in fog.

    Args:
        cloud: (P, 4) with the intensity that the model expects (0 to 1, or 0 to 255 where it rounds and caps).
        fog: settings; the caller applies `scale`.
        rng: draws alpha unless it is set, then one number per moved point in order; the published code takes
            those of `default_rng(42)` after a draw of `integers(1, 20)`.
    """
    out = cloud.astype(np.float64)
    if len(cloud) == 0:
        return FoggyCloud(out, np.zeros(0, bool))
    alpha = EXTINCTIONS[int(rng.random() * len(EXTINCTIONS))] if fog.extinction is None else fog.extinction
    table = fog_table(alpha, fog.pulse_s)
    reach = np.sqrt(out[:, 0] ** 2 + out[:, 1] ** 2 + out[:, 2] ** 2)
    row = np.minimum(np.rint(reach / _STEP_M), len(table.range_m) - 1).astype(np.int64)
    hard = out[:, 3] * np.exp(-2.0 * alpha * reach)
    if fog.rounded:
        hard = np.round(hard)
    soft = table.integral[row] * out[:, 3] * reach**2 * (fog.backscatter / TARGET_BACKSCATTER)
    if fog.cap is not None:
        soft = np.minimum(soft, fog.cap)
    moved = soft > hard
    out[:, 3] = np.where(moved, soft, hard)
    place = table.range_m[row[moved]]
    factor = place / reach[moved]
    if fog.noise > 0.0:
        factor *= _spread(fog, reach[moved], place, rng)
    out[moved, :3] *= factor[:, None]
    if fog.gain:
        out[:, 3] *= 255.0 / np.ceil(out[:, 3].max())
    return FoggyCloud(out, moved)


@lru_cache(maxsize=64)
def fog_table(extinction: float, pulse_s: float = PULSE_S) -> FogTable:
    """Return the table of a fog, from the user's cache or computed.

    Args:
        extinction: alpha, 1/m.
        pulse_s: tau, s.
    """
    name = f"paper_fog_{extinction!r}_{pulse_s!r}_{_TABLE_VERSION}"
    shape = (round(_REACH_M / _STEP_M) + 1,)
    shapes = dict.fromkeys(FogTable._fields, shape)
    return FogTable(**cached_tables(name, shapes, lambda: compute_table(extinction, pulse_s)._asdict()))


def compute_table(extinction: float, pulse_s: float) -> FogTable:
    """Compute the table of a fog.

    Up to a target's range the echo does not depend on the target, so the strongest one is the running maximum of the
    echo of endless fog.
    """
    range_m = np.linspace(0.0, _REACH_M, _ROWS)
    wave = soft_integral(range_m, np.array(np.inf), extinction, pulse_s)
    peak = np.maximum.accumulate(wave)
    place = np.maximum.accumulate(np.where(np.diff(peak, prepend=0.0) > 0.0, np.arange(_ROWS), 0))
    target_m = np.arange(round(_REACH_M / _STEP_M) + 1) * _STEP_M
    last = np.searchsorted(range_m, target_m, side="right") - 1
    return FogTable(range_m[place[last]], peak[last])


def _spread(
    fog: PaperFog, reach: NDArray[np.float64], place: NDArray[np.float64], rng: RandomSource
) -> NDArray[np.float64]:
    """Return (M,) the random factor on moved points."""
    n, m = fog.noise, len(reach)
    if fog.variant == "v1":
        return reach / rng.uniform(reach - n, reach + n)
    if fog.variant == "v2":
        return max(1.0, n / 5.0) ** rng.uniform(-1.0, 1.0, m)
    if fog.variant == "v3":
        return max(1.0, 0.4 * n) ** rng.uniform(-0.5, 1.0, m)
    return (place + 10.0 * rng.beta(2.0, 20.0, m)) / place
