"""Scales of intensity: which value of a file means a reflectivity of 1.

Files say nowhere what their intensities are of, and scans of one folder may not differ in it. So the scale is declared,
or found over all clouds of a folder: fractions, or 8 bits. Anything else is to be declared.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim.errors import DataError, SettingsError, complaint, option

EIGHT_BIT = 255.0
WAYMO = "waymo"
"""Scale without an end: the reflectivity is the hyperbolic tangent of the intensity.

Source: P. Sun et al., Waymo Open Dataset, CVPR 2020; the compression is that of the detectors trained on it."""

Scale = float | Literal["waymo"]
"""Value that means 1, or `WAYMO`."""

_SATURATED = 2.0
"""Largest part of the full scale that is taken for a bright point; a few points above do not change the scale."""
_OUTLIERS = 0.01
"""Largest share of points beyond that."""
_FRACTIONS = 0.5
"""Share of positive values above 1 from which values that are not whole are of 8 bits."""
_ENOUGH = 100
"""Positive values that tell fractions from a dark cloud of 8 bits."""


def parse_scale(given: str | float | None) -> Scale | None:
    """Return a scale that was declared, None for none; SettingsError for anything but a positive number or `waymo`."""
    if given is None or given == WAYMO:
        return given  # type: ignore[return-value]
    try:
        number = float(given)
    except (TypeError, ValueError):
        number = np.nan
    if not 0.0 < number < np.inf:
        expected = f"a positive number, such as 1, 255 or 65535, or {WAYMO}"
        raise SettingsError(complaint("corrupt", option("intensity_scale"), expected, given))
    return number


def to_unit(values: NDArray[np.number], scale: Scale) -> NDArray[np.float32]:
    """Return intensities as reflectivities, 1 for those a little above the scale; more remain above 1."""
    if scale == WAYMO:
        return np.tanh(values.astype(np.float64)).astype(np.float32)
    unit = (values / np.float64(scale)).astype(np.float32)
    far = np.count_nonzero(unit > _SATURATED) > _OUTLIERS * len(unit)
    return unit if far else np.minimum(unit, np.float32(1.0))


def from_unit(unit: NDArray[np.float32], scale: Scale) -> NDArray[np.float64]:
    """Return reflectivities as intensities of a scale."""
    if scale == WAYMO:
        return np.arctanh(np.minimum(unit.astype(np.float64), 1.0 - 2.0**-24))
    return unit * np.float64(scale)


@dataclass(frozen=True, slots=True)
class Intensities:
    """What the intensities of one or many clouds tell of their scale.

    Attributes:
        most: the largest.
        positive: number of them above 0.
        above: number of them above 1.
        whole: whether all are whole numbers.
        bits: whether some are kept as whole numbers, or their format says 8 bits.
        fractions: name of a cloud that is of fractions for sure: none above 1, and many not whole; None without one.
    """

    most: float = 0.0
    positive: int = 0
    above: int = 0
    whole: bool = True
    bits: bool = False
    fractions: str | None = None

    @classmethod
    def of(cls, values: NDArray[np.number], name: str) -> "Intensities":
        """Return those of the intensities of one cloud."""
        values = values[np.isfinite(values)]
        positive, above = int(np.count_nonzero(values > 0)), int(np.count_nonzero(values > 1))
        bits = values.dtype.kind in "iu"
        whole = bits or bool((values == np.floor(values)).all())
        fractions = None if above or whole or positive < _ENOUGH else name
        return cls(float(values.max(initial=0)), positive, above, whole, bits, fractions)

    @classmethod
    def joined(cls, parts: Iterable["Intensities"]) -> "Intensities":
        """Return those of many clouds."""
        all_of = list(parts)
        return cls(
            max((one.most for one in all_of), default=0.0),
            sum(one.positive for one in all_of),
            sum(one.above for one in all_of),
            all(one.whole for one in all_of),
            any(one.bits for one in all_of),
            next((one.fractions for one in all_of if one.fractions is not None), None),
        )

    def scale(self, where: Path | str) -> float:
        """Return the scale that they are of: 1 or 255.

        Raises:
            DataError: they are of neither, or some clouds are of one and some of the other.
        """
        hint = f"; declare what means 1 by {option('intensity_scale')}: 1, 255, 65535, {WAYMO} or another number"
        whole = self.bits or self.whole
        if not self.bits and self.most <= (1.0 if whole else _SATURATED):
            return 1.0
        if self.fractions is not None:
            found = f"fractions in {self.fractions} and values to {self.most:g} in others"
            raise DataError(complaint(where, "intensity", "one scale", found, hint))
        if self.most <= EIGHT_BIT + (not whole) and (whole or self.above > _FRACTIONS * self.positive):
            return EIGHT_BIT
        found = f"{'whole numbers' if whole else 'values'} to {self.most:g}, {self.above / self.positive:.1%} above 1"
        raise DataError(complaint(where, "intensity", "values from 0 to 1, or whole numbers to 255", found, hint))
