"""Point dropping: returns lost at random, or in patches of a covered window.

| severity                  | 1  | 2  | 3  | 4  | 5  |
|---------------------------|----|----|----|----|----|
| share of the beams, %     | 6  | 12 | 18 | 24 | 30 |
| patches of 2 % each       | 2  | 3  | 5  | 7  | 10 |

Shares and patches are those of Dong et al. (CVPR 2023, `density` and `cutout`). `scattered` loses single beams, as
packets and faint returns are lost; `patches` loses all points in some directions, as behind drops, dirt and insects on
the window. A patch is a disc of directions around one point and holds the 2 % of the points nearest to its middle, so
patches may overlap. (The reference's patches are balls around a point in space.) Points lost at a severity are lost at
the next. Level 3 is the middle one of the five published.
"""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.sweep import Sweep

_PATCH_SHARE = 0.02


class PointDropping(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        how: `scattered` over all beams, or in `patches`.
        share: chance that a beam is lost when scattered.
        patches: number of patches.
        patch_share: share of the points in each patch.
    """

    LEVELS: ClassVar = {"share": (0.06, 0.12, 0.18, 0.24, 0.30), "patches": (2, 3, 5, 7, 10)}
    RANGES: ClassVar = {
        "share": (0.0, 1.0),
        "patches": (0, 10_000),
        "patch_share": (0.0, 1.0),
    }

    how: Literal["scattered", "patches"] = "scattered"
    share: float = 0.18
    patches: int = 5
    patch_share: float = _PATCH_SHARE


def corrupt(sweep: Sweep, settings: PointDropping, rng: np.random.Generator) -> Sweep:
    """Remove points; the others are unchanged, in order."""
    if len(sweep) == 0:
        return sweep
    if settings.how == "patches":
        return sweep[~_covered(sweep, settings, rng)]
    return sweep[rng.random(len(sweep), np.float32) >= settings.share]


def _covered(sweep: Sweep, settings: PointDropping, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return (P,) mask of points in a patch."""
    reach = np.maximum(sweep.range, np.float32(1e-6))
    direction = sweep.points / reach[:, None]
    covered = np.zeros(len(sweep), bool)
    size = int(settings.patch_share * len(sweep))
    if size == 0:
        return covered
    for _ in range(settings.patches):
        middle = direction[int(rng.random() * len(sweep))]
        near = direction @ middle
        covered[np.argpartition(-near, size - 1)[:size]] = True
    return covered
