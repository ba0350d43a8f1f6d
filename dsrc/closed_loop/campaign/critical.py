"""Critical value of a quantity: where the outcome of an episode flips, and whether it flips back."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Flip:
    """Change of the outcome between two values.

    Attributes:
        below: largest value tried before the change.
        above: smallest value tried after it.
        fails: it fails above; False where a stronger disturbance does less harm.
    """

    below: float
    above: float
    fails: bool


@dataclass(frozen=True, slots=True)
class CriticalValue:
    """Result of a search.

    Attributes:
        tried: (value, whether the episode ended well), by value.
        flips: all changes of the outcome between values tried, by value.
    """

    tried: tuple[tuple[float, bool], ...]
    flips: tuple[Flip, ...]

    @property
    def monotone(self) -> bool:
        """Whether a stronger disturbance never does less harm."""
        return all(flip.fails for flip in self.flips) and len(self.flips) <= 1

    @property
    def critical(self) -> float | None:
        """Smallest value that fails, to the tolerance of the search; None without one."""
        return next((value for value, fine in self.tried if not fine), None)


def critical_value(
    fine: Callable[[float], bool], values: Sequence[float], tolerance: float, most: int = 40
) -> CriticalValue:
    """Return where the outcome flips along a quantity: all of `values`, then a bisection of every flip between them.

    Outcomes of a closed loop need not be monotone: a late brake can let another car pass. So the flips between the
    values are all searched, and none of them is taken for the only one.

    Args:
        fine: whether the episode at a value ends well.
        values: ascending; at least two.
        tolerance: width at which a bisection ends.
        most: episodes at most.

    Raises:
        ValueError: fewer than two values, values that do not ascend, or a tolerance that is not positive.
    """
    if len(values) < 2 or (np.diff(values) <= 0.0).any() or tolerance <= 0.0:
        raise ValueError(f"expected ascending values and a tolerance > 0, got {tuple(values)} and {tolerance}")
    known = {float(value): fine(float(value)) for value in values[:most]}
    while len(known) < most:
        ordered = sorted(known)
        wide = [
            (low, high)
            for low, high in itertools.pairwise(ordered)
            if known[low] != known[high] and high - low > tolerance
        ]
        if not wide:
            break
        for low, high in wide:
            if len(known) < most:
                known[0.5 * (low + high)] = fine(0.5 * (low + high))
    ordered = sorted(known)
    flips = tuple(Flip(low, high, known[low]) for low, high in itertools.pairwise(ordered) if known[low] != known[high])
    return CriticalValue(tuple((value, known[value]) for value in ordered), flips)
