"""Published corruptions that shake, replace or delete points one by one.

| severity                                          | 1    | 2    | 3          | 4    | 5    |
|---------------------------------------------------|------|------|------------|------|------|
| motion blur: deviation of a coordinate, m         | 0.08 | 0.1  | 0.2 (DSRC) | 0.25 | 0.3  |
| crosstalk: share of the points, %                 | 0.6  | 0.8  | 1 (DSRC)   | 1.6  | 2    |
| sunlight: share of the points, %                  | 1    | 2    | 3          | 4    | 5    |
| noise, gaussian (deviation) or uniform (bound), m | 0.02 | 0.04 | 0.06       | 0.08 | 0.1  |
| noise, impulse: one point of ... by 0.1 m         | 30   | 25   | 20         | 15   | 10   |
| dropping, density: points deleted, %              | 6    | 12   | 18         | 24   | 30   |
| dropping, cutout: cuts of 2 % of the points       | 2    | 3    | 5          | 7    | 10   |
| field of view: kept to either side, degrees       | 105  | 90   | 75         | 60   | 45   |

Besides DSRC's, the blurs are Robo3D's, the crosstalks of 1 and 2 (and 3) too, those of 4 and 5 and all other rows
3D_Corruptions_AD's. `PUBLISHED_...` has them all by name.

Formulas, with g and u drawn per point and column from N(0, 1) and U(-1, 1):

* motion blur: p + s g, on the coordinates in DSRC's text, on the intensity too (`columns="all"`) in its code. Robo3D
  (`shared`): one N(0, s) per axis for the whole frame, and 0.1 s g (z: 0.05 s g) clipped at 3 s, which never happens;
  s = 0.2, 0.25, 0.3 m for SemanticKITTI, 0.04, 0.08, 0.1 m for KITTI. Nothing in it knows of motion or time.
* crosstalk: int(share P) points drawn without replacement, p + 3 g; sunlight: p + 2 g. On all columns, the intensity
  included, of which then half are beyond [0, 1]. (DSRC changes its input in place, which is not kept.)
* noise: p + s g, p + s u; impulse: P // n points, each column by + or - 0.1. On all columns.
* density: int(f int(0.3 P)) points deleted, f = 0.2 to 1. Cutout: again and again a random point and its
  int(0.02 P) - 1 nearest, by the distance over all columns.
* field of view: kept where the angle from +y is within the limit, both ends included; 3D_Corruptions_AD's frame has +y
  ahead. `ahead="x"` is for frames like ours.

`columns` says which columns are shaken: four for a cloud of x, y, z, intensity; nuScenes' ring, a fifth, is shaken too
where the release does. What a lower severity draws is the beginning of what a higher one draws.
"""

from typing import Literal, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import at_level, check_range
from sensors.corruptions.published.cloud import Cloud, Draws, cloud_of, with_cloud, with_rows
from sensors.sweep import KEPT, MOVED, Sweep

Columns = Literal["coordinates", "all"]

BLUR_M = (0.08, 0.1, 0.2, 0.25, 0.3)
CROSSTALK_SHARE = (0.006, 0.008, 0.01, 0.016, 0.02)
SUNLIGHT_SHARE = (0.01, 0.02, 0.03, 0.04, 0.05)
NOISE_M = (0.02, 0.04, 0.06, 0.08, 0.10)
IMPULSE_ONE_OF = (30, 25, 20, 15, 10)
DENSITY_FRACTION = (0.2, 0.4, 0.6, 0.8, 1.0)
CUTS = (2, 3, 5, 7, 10)
HALF_FIELD_DEG = (105.0, 90.0, 75.0, 60.0, 45.0)

_OWN_JITTER = (0.1, 0.1, 0.05)
_JITTER_CLIP = 3.0
_IMPULSE_M = 0.1
_DENSITY_MOST = 0.3
_CUT_SHARE = 0.02


class MotionBlur(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `motion_blur`.

    Attributes:
        deviation_m: s.
        columns: what is shaken.
        shared: the whole frame is displaced, and points by a tenth of it (Robo3D); coordinates only.
    """

    deviation_m: float = 0.2
    columns: Columns = "coordinates"
    shared: bool = False

    def __post_init__(self) -> None:
        check_range("MotionBlur", "deviation_m", self.deviation_m, 0.0, 100.0)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(deviation_m=at_level(BLUR_M, level))


class Crosstalk(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `crosstalk`.

    Attributes:
        share: of the points that are touched.
        deviation_m: of what is added to each column.
        columns: what is shaken.
    """

    share: float = 0.01
    deviation_m: float = 3.0
    columns: Columns = "all"

    def __post_init__(self) -> None:
        check_range("Crosstalk", "share", self.share, 0.0, 1.0)
        check_range("Crosstalk", "deviation_m", self.deviation_m, 0.0, 1000.0)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(share=at_level(CROSSTALK_SHARE, level))


class Sunlight(Crosstalk, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `sunlight`, which is crosstalk with other numbers."""

    share: float = 0.03
    deviation_m: float = 2.0

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(share=at_level(SUNLIGHT_SHARE, level))


class Noise(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `noise`.

    Attributes:
        law: of what is added.
        size_m: deviation (gaussian), bound (uniform) or step (impulse).
        one_of: impulses hit one point of so many.
        columns: what is shaken.
    """

    law: Literal["gaussian", "uniform", "impulse"] = "gaussian"
    size_m: float = 0.06
    one_of: int = 20
    columns: Columns = "all"

    def __post_init__(self) -> None:
        check_range("Noise", "size_m", self.size_m, 0.0, 100.0)
        check_range("Noise", "one_of", self.one_of, 1, 1_000_000)

    @classmethod
    def severity(cls, level: int, law: Literal["gaussian", "uniform", "impulse"] = "gaussian") -> Self:
        """Return the settings of a severity, 1 to 5."""
        size_m = _IMPULSE_M if law == "impulse" else at_level(NOISE_M, level)
        return cls(law=law, size_m=size_m, one_of=at_level(IMPULSE_ONE_OF, level))


class PointDropping(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `point_dropping`.

    Attributes:
        law: `density` deletes points one by one, `cutout` neighbourhoods.
        fraction: of the most, 30 %, that density deletes.
        cuts: number of neighbourhoods of 2 %.
    """

    law: Literal["density", "cutout"] = "density"
    fraction: float = 0.6
    cuts: int = 5

    def __post_init__(self) -> None:
        check_range("PointDropping", "fraction", self.fraction, 0.0, 1.0 / _DENSITY_MOST)
        check_range("PointDropping", "cuts", self.cuts, 0, 50)

    @classmethod
    def severity(cls, level: int, law: Literal["density", "cutout"] = "density") -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(law=law, fraction=at_level(DENSITY_FRACTION, level), cuts=at_level(CUTS, level))


class FieldOfView(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `field_of_view`.

    Attributes:
        half_deg: kept to either side, degrees.
        ahead: axis that the angle counts from.
    """

    half_deg: float = 75.0
    ahead: Literal["x", "y"] = "y"

    def __post_init__(self) -> None:
        check_range("FieldOfView", "half_deg", self.half_deg, 0.0, 180.0)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(half_deg=at_level(HALF_FIELD_DEG, level))


PUBLISHED_MOTION_BLUR: dict[str, MotionBlur] = {
    "dsrc_text": MotionBlur(),
    "dsrc": MotionBlur(columns="all"),
    "robo3d_kitti_light": MotionBlur(deviation_m=0.04, shared=True),
    "robo3d_kitti_moderate": MotionBlur(deviation_m=0.08, shared=True),
    "robo3d_kitti_heavy": MotionBlur(deviation_m=0.10, shared=True),
    "robo3d_semantickitti_light": MotionBlur(deviation_m=0.20, shared=True),
    "robo3d_semantickitti_moderate": MotionBlur(deviation_m=0.25, shared=True),
    "robo3d_semantickitti_heavy": MotionBlur(deviation_m=0.30, shared=True),
    "robo3d_nuscenes_light": MotionBlur(deviation_m=0.20, shared=True),
}

PUBLISHED_CROSSTALK: dict[str, Crosstalk] = {
    "dsrc": Crosstalk(),
    "robo3d_light": Crosstalk(share=0.006),
    "robo3d_moderate": Crosstalk(share=0.008),
    "robo3d_heavy": Crosstalk(share=0.01),
    "robo3d_nuscenes_light": Crosstalk(share=0.03),
    **{f"3d_corruptions_ad_{k}": Crosstalk(share=0.004 * k) for k in range(1, 6)},
}


def motion_blur(sweep: Sweep, severity: int | MotionBlur, rng: Draws) -> Sweep:
    """Displace every point; each is still a return of its object."""
    settings = severity if isinstance(severity, MotionBlur) else MotionBlur.severity(severity)
    if settings.deviation_m == 0.0:
        return sweep
    return with_cloud(sweep, blurred(cloud_of(sweep), settings, rng), np.full(len(sweep), MOVED))


def crosstalk(sweep: Sweep, severity: int | Crosstalk, rng: Draws) -> Sweep:
    """Replace a share of the points by noise around them, which is of no object."""
    settings = severity if isinstance(severity, Crosstalk) else Crosstalk.severity(severity)
    touched, shake = _mistakes((len(sweep), 4), settings, rng)
    return with_rows(sweep, touched, cloud_of(sweep[touched]) + shake)


def sunlight(sweep: Sweep, severity: int | Sunlight, rng: Draws) -> Sweep:
    """Replace a share of the points by noise around them, which is of no object."""
    settings = severity if isinstance(severity, Sunlight) else Sunlight.severity(severity)
    return crosstalk(sweep, settings, rng)


def noise(sweep: Sweep, severity: int | Noise, rng: Draws) -> Sweep:
    """Shake the points; each is still a return of its object."""
    settings = severity if isinstance(severity, Noise) else Noise.severity(severity)
    if settings.size_m == 0.0:
        return sweep
    cloud, touched = shaken(cloud_of(sweep), settings, rng)
    fate = np.full(len(sweep), KEPT)
    fate[touched] = MOVED
    return with_cloud(sweep, cloud, fate)


def point_dropping(sweep: Sweep, severity: int | PointDropping, rng: Draws) -> Sweep:
    """Delete points."""
    settings = severity if isinstance(severity, PointDropping) else PointDropping.severity(severity)
    # Density counts points, only cutout looks where they are.
    cloud = cloud_of(sweep) if settings.law == "cutout" else sweep.points
    return sweep[remaining(cloud, settings, rng)]


def field_of_view(sweep: Sweep, severity: int | FieldOfView, rng: Draws) -> Sweep:
    """Delete what is not ahead; `rng` is not used."""
    settings = severity if isinstance(severity, FieldOfView) else FieldOfView.severity(severity)
    return sweep[ahead(sweep.points, settings)]


def blurred(cloud: Cloud, settings: MotionBlur, rng: Draws) -> NDArray[np.float64]:
    """Return the cloud shaken by motion blur."""
    s = settings.deviation_m
    if not settings.shared:
        return _plus(cloud, rng.normal(0.0, s, (len(cloud), _width(cloud, settings.columns))))
    frame = rng.normal(0.0, s, 3)
    own = rng.normal(0.0, s, (3, len(cloud))).T * np.array(_OWN_JITTER)
    return _plus(cloud, frame + np.clip(own, -_JITTER_CLIP * s, _JITTER_CLIP * s))


def mistaken(cloud: Cloud, settings: Crosstalk, rng: Draws) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the cloud with the touched points displaced, and (K,) their rows in the order of drawing."""
    touched, shake = _mistakes(cloud.shape, settings, rng)
    out = cloud.astype(np.float64)
    out[touched] += shake
    return out, touched


def _mistakes(shape: tuple[int, ...], settings: Crosstalk, rng: Draws) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return (K,) which rows of a cloud of some shape are touched, and (K, columns) by what."""
    touched = rng.permutation(shape[0])[: int(settings.share * shape[0])]
    # Coordinates get what they would get if all columns were shaken.
    shake = rng.normal(size=(len(touched), shape[1])) * settings.deviation_m
    if settings.columns == "coordinates":
        shake[:, 3:] = 0.0
    return touched, shake


def shaken(cloud: Cloud, settings: Noise, rng: Draws) -> tuple[NDArray[np.float64], NDArray[np.int64] | slice]:
    """Return the cloud with noise, and the rows that it touched."""
    shape = (len(cloud), _width(cloud, settings.columns))
    if settings.law == "uniform":
        return _plus(cloud, rng.uniform(-settings.size_m, settings.size_m, shape)), slice(None)
    if settings.law == "gaussian":
        return _plus(cloud, rng.normal(0.0, settings.size_m, shape)), slice(None)
    touched = rng.permutation(len(cloud))[: len(cloud) // settings.one_of]
    sign = 2.0 * (rng.random((len(touched), cloud.shape[1])) < 0.5) - 1.0
    out = cloud.astype(np.float64)
    out[touched, : shape[1]] += settings.size_m * sign[:, : shape[1]]
    return out, touched


def remaining(cloud: Cloud, settings: PointDropping, rng: Draws) -> NDArray[np.bool_]:
    """Return (P,) which points are left."""
    n = len(cloud)
    if settings.law == "cutout":
        return _left_by_cuts(cloud, settings.cuts, rng)
    left = np.ones(n, bool)
    left[rng.permutation(n)[: int(settings.fraction * int(_DENSITY_MOST * n))]] = False
    return left


def ahead(points: Cloud, settings: FieldOfView) -> NDArray[np.bool_]:
    """Return (P,) which points are within the field of view."""
    forward, side = (points[:, 0], points[:, 1]) if settings.ahead == "x" else (points[:, 1], points[:, 0])
    return np.abs(np.degrees(np.arctan2(side, forward))) <= settings.half_deg


def _left_by_cuts(cloud: Cloud, cuts: int, rng: Draws) -> NDArray[np.bool_]:
    n, size = len(cloud), int(_CUT_SHARE * len(cloud))
    rows = np.arange(n)
    columns = np.ascontiguousarray(cloud.T, dtype=np.float32)
    for _ in range(cuts if size else 0):
        center = columns[:, int(rng.random() * len(rows))]
        distance = np.zeros(len(rows), np.float32)
        for column, value in zip(columns, center, strict=True):
            distance += (column - value) ** 2
        far = np.argpartition(distance, size)[size:]
        rows, columns = rows[far], columns[:, far]
    left = np.zeros(n, bool)
    left[rows] = True
    return left


def _plus(cloud: Cloud, shake: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cloud with `shake`, which is used up, added to its first columns."""
    if shake.shape == cloud.shape:
        shake += cloud
        return shake
    out = cloud.astype(np.float64)
    out[:, : shake.shape[1]] += shake
    return out


def _width(cloud: Cloud, columns: Columns) -> int:
    return cloud.shape[1] if columns == "all" else 3
