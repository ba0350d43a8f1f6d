"""What a report says beside the results of a campaign: its gate's verdicts, and what the logs of its episodes tell."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.causes.cause import KINDS, Cause, Kind
from dsrc.closed_loop.report.cells import condition
from dsrc.closed_loop.report.gate import NO_GATE, Gate
from dsrc.evaluation.metrics.calibration import Reliability
from dsrc.tables.files import csv_text


@dataclass(frozen=True, slots=True)
class Findings:
    """What a report says beside the results.

    Attributes:
        gate: what was asked of them.
        causes: of crashes whose logs are there, by the keys of their episodes.
        calibrations: of the detections of episodes whose logs are there, by their keys.
    """

    gate: Gate = NO_GATE
    causes: Mapping[str, Cause] = field(default_factory=dict)
    calibrations: Mapping[str, Reliability] = field(default_factory=dict)

    @property
    def sentences(self) -> dict[str, str]:
        """Causes in words."""
        return {key: cause.sentence for key, cause in self.causes.items()}


NOTHING = Findings()
"""Nothing but the results."""


def counted_causes(
    results: Sequence[EpisodeResult], causes: Mapping[str, Cause]
) -> tuple[list[Kind], dict[tuple[str, str], dict[Kind, int]]]:
    """Return the kinds of causes that crashes have, and their numbers by perception and condition."""
    counts: dict[tuple[str, str], dict[Kind, int]] = {}
    for one in results:
        if (cause := causes.get(one.key)) is not None:
            own = counts.setdefault((one.perception, condition(one)), dict.fromkeys(KINDS, 0))
            own[cause.kind] += 1
    kinds = [kind for kind in KINDS if any(own[kind] for own in counts.values())]
    return kinds, counts


def joined_calibrations(
    results: Sequence[EpisodeResult], found: Mapping[str, Reliability]
) -> dict[tuple[str, str], tuple[int, Reliability]]:
    """Return number of episodes and reliability curve by perception and condition, of perceptions with scores.

    Eyes that are always sure, like the truth, have none to calibrate.
    """
    groups: dict[tuple[str, str], list[Reliability]] = {}
    for one in results:
        if (own := found.get(one.key)) is not None:
            groups.setdefault((one.perception, condition(one)), []).append(own)
    joined = {key: (len(parts), Reliability.joined(parts)) for key, parts in groups.items()}
    return {key: (count, own) for key, (count, own) in joined.items() if np.nanmin(own.score, initial=1.0) < 1.0}


def causes_csv(results: Sequence[EpisodeResult], causes: Mapping[str, Cause]) -> str:
    """Return the causes as CSV, a line per crash."""
    named = ["scenario", "perception", "corruption", "severity", "who", "channel", "fault", "seed", "key"]
    named += ["defence"] if any(one.defence for one in results) else []
    rows = [
        {name: getattr(one, name) for name in named} | msgspec.to_builtins(causes[one.key])
        for one in results
        if one.key in causes
    ]
    return csv_text(rows, (*named, *Cause.__struct_fields__))
