"""Motion blur and crosstalk, as published: points shaken or displaced one by one.

| severity                                   | 1    | 2   | 3          | 4    | 5   |
|--------------------------------------------|------|-----|------------|------|-----|
| motion blur: deviation of a coordinate, m  | 0.08 | 0.1 | 0.2 (DSRC) | 0.25 | 0.3 |
| crosstalk: share of the points, %          | 0.6  | 0.8 | 1 (DSRC)   | 1.6  | 2   |

Besides DSRC's, the blurs are Robo3D's, the crosstalks of 1 to 3 too, those of 4 and 5 3D_Corruptions_AD's.

Formulas, with g drawn per point and column from N(0, 1):

* motion blur: p + s g, on the coordinates in DSRC's text, on the intensity too (`columns="all"`) in its code. Robo3D
  (`shared`): one N(0, s) per axis for the whole frame, and 0.1 s g (z: 0.05 s g) clipped at 3 s, which never happens;
  s = 0.2, 0.25, 0.3 m for SemanticKITTI, 0.04, 0.08, 0.1 m for KITTI. MultiCorrupt: the same with 0.06, 0.1, 0.13 m,
  and 0.15, 0.2, 0.12 s g along x, y, z. The model has no motion and no time.
* crosstalk: int(share P) points drawn without replacement, p + 3 g, on all columns, the intensity included, of which
  then half are beyond [0, 1]. (DSRC changes its input in place; this module does not.)

`columns` selects the columns that are shaken: four for a cloud of x, y, z, intensity; nuScenes' ring, a fifth, is
shaken too where the release does. The draws of a lower severity are the first of those of a higher one.
"""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.corruptions.published.cloud import Cloud, RandomSource, cloud_of, with_cloud, with_rows
from sensors.sweep import MOVED, Sweep

Columns = Literal["coordinates", "all"]


_JITTER_CLIP = 3.0


class PaperMotionBlur(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `motion_blur`.

    Attributes:
        deviation_m: s.
        columns: columns with noise.
        shared: one offset for the whole frame, and `own` of its deviation per point (Robo3D); coordinates only.
        own: deviation of a point along x, y, z as a share of `deviation_m`.
    """

    LEVELS: ClassVar = {"deviation_m": (0.08, 0.1, 0.2, 0.25, 0.3)}
    RANGES: ClassVar = {"deviation_m": (0.0, 100.0)}

    deviation_m: float = 0.2
    columns: Columns = "coordinates"
    shared: bool = False
    own: tuple[float, float, float] = (0.1, 0.1, 0.05)


class PaperCrosstalk(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `crosstalk`.

    Attributes:
        share: of the points that are displaced.
        deviation_m: deviation of the noise on each column.
        columns: columns with noise.
    """

    LEVELS: ClassVar = {"share": (0.006, 0.008, 0.01, 0.016, 0.02)}
    RANGES: ClassVar = {"share": (0.0, 1.0), "deviation_m": (0.0, 1000.0)}

    share: float = 0.01
    deviation_m: float = 3.0
    columns: Columns = "all"


PUBLISHED_MOTION_BLUR: dict[str, PaperMotionBlur] = {
    "dsrc_text": PaperMotionBlur(),
    "dsrc": PaperMotionBlur(columns="all"),
    "robo3d_kitti_light": PaperMotionBlur(deviation_m=0.04, shared=True),
    "robo3d_kitti_moderate": PaperMotionBlur(deviation_m=0.08, shared=True),
    "robo3d_kitti_heavy": PaperMotionBlur(deviation_m=0.10, shared=True),
    "robo3d_semantickitti_light": PaperMotionBlur(deviation_m=0.20, shared=True),
    "robo3d_semantickitti_moderate": PaperMotionBlur(deviation_m=0.25, shared=True),
    "robo3d_semantickitti_heavy": PaperMotionBlur(deviation_m=0.30, shared=True),
    "robo3d_nuscenes_light": PaperMotionBlur(deviation_m=0.20, shared=True),
    "multicorrupt_1": PaperMotionBlur(deviation_m=0.06, shared=True, own=(0.15, 0.2, 0.12)),
    "multicorrupt_2": PaperMotionBlur(deviation_m=0.10, shared=True, own=(0.15, 0.2, 0.12)),
    "multicorrupt_3": PaperMotionBlur(deviation_m=0.13, shared=True, own=(0.15, 0.2, 0.12)),
}

PUBLISHED_CROSSTALK: dict[str, PaperCrosstalk] = {
    "dsrc": PaperCrosstalk(),
    "robo3d_light": PaperCrosstalk(share=0.006),
    "robo3d_moderate": PaperCrosstalk(share=0.008),
    "robo3d_heavy": PaperCrosstalk(share=0.01),
    "robo3d_nuscenes_light": PaperCrosstalk(share=0.03),
}


def motion_blur(sweep: Sweep, settings: PaperMotionBlur, rng: RandomSource) -> Sweep:
    """Displace every point; each stays a return of its object."""
    if settings.deviation_m == 0.0:
        return sweep
    return with_cloud(sweep, apply_motion_blur(cloud_of(sweep), settings, rng), np.full(len(sweep), MOVED))


def crosstalk(sweep: Sweep, settings: PaperCrosstalk, rng: RandomSource) -> Sweep:
    """Replace a share of the points by noise around them, on no object."""
    touched, shake = crosstalk_noise((len(sweep), 4), settings, rng)
    return with_rows(sweep, touched, cloud_of(sweep[touched]) + shake)


def apply_motion_blur(cloud: Cloud, settings: PaperMotionBlur, rng: RandomSource) -> NDArray[np.float64]:
    """Return the cloud with motion blur."""
    s = settings.deviation_m
    if not settings.shared:
        width = cloud.shape[1] if settings.columns == "all" else 3
        return _plus(cloud, rng.normal(0.0, s, (len(cloud), width)))
    frame = rng.normal(0.0, s, 3)
    own = rng.normal(0.0, s, (3, len(cloud))).T * np.array(settings.own)
    return _plus(cloud, frame + np.clip(own, -_JITTER_CLIP * s, _JITTER_CLIP * s))


def crosstalk_noise(
    shape: tuple[int, ...], settings: PaperCrosstalk, rng: RandomSource
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return (K,) displaced rows of a cloud of a shape, and (K, columns) their displacement."""
    touched = rng.permutation(shape[0])[: int(settings.share * shape[0])]
    # Coordinates get the same noise as with all columns.
    shake = rng.normal(size=(len(touched), shape[1])) * settings.deviation_m
    if settings.columns == "coordinates":
        shake[:, 3:] = 0.0
    return touched, shake


def _plus(cloud: Cloud, shake: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cloud with `shake`, which is overwritten, added to its first columns."""
    if shake.shape == cloud.shape:
        shake += cloud
        return shake
    out = cloud.astype(np.float64)
    out[:, : shake.shape[1]] += shake
    return out
