"""ErrorFilter: which errors of a run are listed and which objects its average precision is of."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.review.errors.judged import JudgedRun
from sensors.frame import BY_EGO, BY_HELPER, BY_NOBODY
from sim.boxes import CLASSES
from sim.errors import SettingsError, complaint, did_you_mean

FN, FP, POOR = range(3)
"""Kinds of errors: a missed object, a false detection, an object found with little overlap."""
KINDS = ("missed", "false", "poor")
"""Names of the kinds."""
SEERS = {"ego": BY_EGO, "helper": BY_HELPER, "nobody": BY_NOBODY}
"""Names of who has points on an object."""


class Span(NamedTuple):
    """Range of a quantity, ends included."""

    low: float
    high: float

    def holds(self, values: NDArray) -> NDArray[np.bool_]:
        """Mask of the values within; NaN is outside."""
        return (values >= self.low) & (values <= self.high)


ANY = Span(-np.inf, np.inf)


@dataclass(frozen=True, slots=True)
class ErrorFilter:
    """Filter of errors. An open field passes everything; a closed one no error that lacks the property.

    Kind and method choose errors. The others choose objects, and so counts and average precision too: objects outside
    count neither as found nor as missed. False detections are of no object: distance alone chooses among them there, as
    in `dsrc.evaluation.metrics.ap.evaluate_matches`.

    Attributes:
        kinds: of errors, names of `KINDS`.
        methods: names of sets; empty for all.
        distance_m: from the ego's LiDAR in the plane.
        classes: names of `sim.boxes.CLASSES`; empty for all.
        seen_by: who has points on the object before the corruption, names of `SEERS`; empty for all.

    Raises:
        SettingsError: a name is unknown, or the span is empty.
    """

    kinds: tuple[str, ...] = KINDS
    methods: tuple[str, ...] = ()
    distance_m: Span = ANY
    classes: tuple[str, ...] = ()
    seen_by: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for field, known in (("kinds", KINDS), ("classes", CLASSES), ("seen_by", tuple(SEERS))):
            for name in getattr(self, field):
                if name not in known:
                    raise SettingsError(complaint("filter", field, "a known name", name, did_you_mean(name, known)))
        low, high = self.distance_m
        if not low <= high:
            raise SettingsError(complaint("filter", "distance_m", "a range from low to high", f"{low} to {high}"))

    def objects(self, run: JudgedRun) -> NDArray[np.bool_]:
        """(N,) true boxes of a run that count."""
        chosen = self.distance_m.holds(run.truth_distance_m)
        if self.classes:
            chosen &= np.isin(run.table.label, [CLASSES.index(name) for name in self.classes])
        if self.seen_by:
            chosen &= np.isin(run.visibility, [SEERS[name] for name in self.seen_by])
        return chosen

    def places(self, run: JudgedRun) -> NDArray[np.bool_]:
        """(D,) detections of a run that count as false where they hit nothing."""
        return self.distance_m.holds(run.distance_m)
