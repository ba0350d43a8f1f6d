"""Beam missing: dead lasers.

| severity             | 1 | 2 | 3  | 4  | 5  |
|----------------------|---|---|----|----|----|
| rings missing, of 64 | 4 | 8 | 16 | 32 | 48 |

Other sensors lose the same share of their rings. The number of missing rings is exact, each ring is equally likely, and
those of a lower severity are among those of a higher one. A dead laser stays dead: with the same random stream the same
rings are missing in every sweep of a sensor, also where rings are estimated by elevation (`rings`) and some of them are
empty for a while. Level 3 is the DSRC paper's text, 4 its released code.
"""

from typing import ClassVar

import numpy as np

from sensors.corruptions.physics.levels import SeveritySettings, proportional_rings
from sensors.corruptions.physics.rings import IDENTITIES, rings_of
from sensors.sweep import Sweep


class BeamMissing(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        rings_of_64: rings that a sensor of 64 rings loses; others in proportion.
    """

    LEVELS: ClassVar = {"rings_of_64": (4, 8, 16, 32, 48)}
    RANGES: ClassVar = {"rings_of_64": (0, 64)}

    rings_of_64: int = 16


def corrupt(sweep: Sweep, settings: BeamMissing, rng: np.random.Generator) -> Sweep:
    """Remove all points of some rings; the others are unchanged, in order.

    Args:
        sweep: any sweep; of an unknown sensor only rings with points count.

    Raises:
        DataError: rings are missing and cannot be estimated, or are not those of the sensor.
    """
    lifetime = rng.random(IDENTITIES)
    if settings.rings_of_64 == 0:
        return sweep
    rings = rings_of(sweep, "beam_missing")
    order = np.argsort(lifetime[rings.identity], kind="stable")
    alive = np.ones(rings.count, bool)
    alive[order[: proportional_rings(rings.count, settings.rings_of_64)]] = False
    return sweep[alive[rings.ring]]
