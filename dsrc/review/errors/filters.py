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

    Kind, method, score and IoU choose errors. The others choose objects, and so counts and average precision too:
    objects outside count neither as found nor as missed. False detections are of no object: distance and frame alone
    choose among them there, as in `dsrc.evaluation.metrics.ap.evaluate_matches`.

    Attributes:
        kinds: of errors, names of `KINDS`.
        methods: names of sets; empty for all.
        score: of the detection; a missed object without one has NaN.
        iou: of the detection and its object, or of the pair that overlaps most.
        distance_m: from the ego's LiDAR in the plane.
        frames: numbers of frames.
        classes: names of `sim.boxes.CLASSES`; empty for all.
        seen_by: who has points on the object before the corruption, names of `SEERS`; empty for all.
        points: of all agents on the object before the corruption.
        points_left: of all agents on the object after it.

    Raises:
        SettingsError: a name is unknown, or a span is empty.
    """

    kinds: tuple[str, ...] = KINDS
    methods: tuple[str, ...] = ()
    score: Span = ANY
    iou: Span = ANY
    distance_m: Span = ANY
    frames: Span = ANY
    classes: tuple[str, ...] = ()
    seen_by: tuple[str, ...] = ()
    points: Span = ANY
    points_left: Span = ANY

    def __post_init__(self) -> None:
        for field, known in (("kinds", KINDS), ("classes", CLASSES), ("seen_by", tuple(SEERS))):
            for name in getattr(self, field):
                if name not in known:
                    raise SettingsError(complaint("filter", field, "a known name", name, did_you_mean(name, known)))
        for field in ("score", "iou", "distance_m", "frames", "points", "points_left"):
            low, high = getattr(self, field)
            if not low <= high:
                raise SettingsError(complaint("filter", field, "a range from low to high", f"{low} to {high}"))

    def objects(self, run: JudgedRun) -> NDArray[np.bool_]:
        """(N,) true boxes of a run that count."""
        table = run.table
        chosen = self.distance_m.holds(run.truth_distance_m)
        chosen &= self.frames.holds(table.index)[run.truth_frame_of]
        if self.classes:
            chosen &= np.isin(table.label, [CLASSES.index(name) for name in self.classes])
        if self.seen_by:
            chosen &= np.isin(run.visibility, [SEERS[name] for name in self.seen_by])
        for span, column in ((self.points, 1), (self.points_left, 3)):
            if span != ANY:
                chosen &= span.holds(table.points[:, column]) & (table.points[:, column] >= 0)
        return chosen

    def places(self, run: JudgedRun) -> NDArray[np.bool_]:
        """(D,) detections of a run that count as false where they hit nothing."""
        return self.distance_m.holds(run.distance_m) & self.frames.holds(run.table.index)[run.frame_of]

    @property
    def of_objects(self) -> bool:
        """Whether it closes a property of objects that a detection of nothing lacks."""
        return bool(self.classes or self.seen_by) or self.points != ANY or self.points_left != ANY
