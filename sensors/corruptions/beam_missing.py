"""Beam missing: some lasers are dead.

| severity             | 1 | 2 | 3 (paper) | 4 (released code) | 5  |
|----------------------|---|---|-----------|-------------------|----|
| rings missing, of 64 | 4 | 8 | 16        | 32                | 48 |

Other sensors lose the same share of their rings. With one random stream the rings of a lower severity are among those
of a higher one. Source: DSRC, section on robustness.
"""

from typing import Self

import msgspec
import numpy as np

from sensors.corruptions.levels import at_level, check_range, share_of
from sensors.corruptions.receiver import known_ring_count
from sensors.sweep import Sweep

RINGS_OF_64 = (4, 8, 16, 32, 48)


class BeamMissing(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        rings_of_64: rings that a sensor of 64 rings loses; others in proportion.
    """

    rings_of_64: int = 16

    def __post_init__(self) -> None:
        check_range("BeamMissing", "rings_of_64", self.rings_of_64, 0, 64)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(rings_of_64=at_level(RINGS_OF_64, level))


def corrupt(sweep: Sweep, severity: int | BeamMissing, rng: np.random.Generator) -> Sweep:
    """Remove all points of some rings, drawn without replacement; the other points stay as they are, in order.

    Raises:
        DataError: the sweep does not know its rings.
    """
    settings = severity if isinstance(severity, BeamMissing) else BeamMissing.severity(severity)
    rings = known_ring_count(sweep, "beam_missing")
    alive = np.ones(rings, bool)
    alive[rng.permutation(rings)[: share_of(rings, settings.rings_of_64)]] = False
    return sweep[alive[sweep.ring]]
