"""Conditions that the results of a campaign have to meet: `crashed<=5%`, `team: pdms>=0.8`, `broken<=0`."""

import math
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.metrics.comparison import Value, arrived, collided, counted, metric
from dsrc.closed_loop.metrics.episode import EpisodeMetrics
from dsrc.closed_loop.metrics.statistics import UNKNOWN, Estimate, mean, rate
from dsrc.closed_loop.report.baseline import Change
from dsrc.closed_loop.report.scores import success
from dsrc.closed_loop.types import FAILED, Outcome
from dsrc.tables.table import Table
from sim.errors import SettingsError, complaint, did_you_mean

_SIGNS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
_FORM = re.compile(
    r"\s*(?:(?P<perception>.+):)?\s*(?P<name>\w+)\s*(?P<sign><=|>=|<|>)\s*(?P<bound>[^\s%]+)\s*(?P<percent>%?)\s*"
)


def _ends(*outcomes: Outcome) -> Value:
    return lambda one: float(one.outcome in outcomes)


_COUNTED: dict[str, Value] = {
    "crashed": collided,
    "at_fault": lambda one: metric(one, "at_fault"),
    "stuck": _ends(Outcome.STUCK),
    "timeout": _ends(Outcome.TIMEOUT),
    "left": _ends(Outcome.LEFT),
}
"""Shares of the episodes that met their encounter and whose perception and driver worked."""
_OF_ALL: dict[str, Value] = {"lost": _ends(Outcome.DESYNCHRONISED), "failed": _ends(*FAILED)}
"""Shares of all episodes."""
_CHANGES = ("fixed", "broken")
"""Numbers of episodes that changed against a baseline."""
_MET: dict[str, Value] = {"arrived": arrived, "success": success}
"""Shares of the episodes that met their encounter."""
_SHARES = (*_COUNTED, *_OF_ALL, *_MET)
_METRICS = tuple(name for name in EpisodeMetrics.__struct_fields__ if name not in _SHARES)


@dataclass(frozen=True, slots=True)
class Condition:
    """Condition on each perception of a campaign.

    Attributes:
        text: as it was written.
        perception: name of the only perception that it is about; "" for every one.
        quantity: share of episodes, mean of a metric, or number of changes.
        sign: relation of the quantity to the bound.
        bound: a share, 0 to 1, or in the unit of the metric.
    """

    text: str
    perception: str
    quantity: str
    sign: str
    bound: float

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the condition of a text `[PERCEPTION:] QUANTITY SIGN NUMBER[%]`.

        Raises:
            SettingsError: the text has another form, the quantity is unknown, or the number is none.
        """
        found = _FORM.fullmatch(text)
        if found is None:
            raise SettingsError(_wrong("a condition such as crashed<=5% or 'team: driving_score_2_1>=0.8'", text))
        name, percent = found["name"], bool(found["percent"])
        known = (*_SHARES, *_CHANGES, *_METRICS)
        if name not in known:
            raise SettingsError(_wrong("a share of episodes or a metric", name, did_you_mean(name, known)))
        if percent and name not in _SHARES:
            raise SettingsError(_wrong(f"a number without % for {name}", text))
        try:
            bound = float(found["bound"]) / (100.0 if percent else 1.0)
        except ValueError:
            bound = math.nan
        if not math.isfinite(bound) or (name in _SHARES and not 0.0 <= bound <= 1.0):
            expected = "a share of 0 to 1, or 0% to 100%" if name in _SHARES else "a finite number"
            raise SettingsError(_wrong(f"{expected} for {name}", found["bound"] + found["percent"]))
        return cls(text.strip(), (found["perception"] or "").strip(), name, found["sign"], bound)

    def estimate(self, results: Sequence[EpisodeResult], changes: Sequence[Change]) -> tuple[Estimate, int]:
        """Return the quantity of some episodes, and the number of episodes that it is of."""
        if self.quantity in _CHANGES:
            number = float(sum(change.kind == self.quantity for change in changes))
            paired = sum(change.paired for change in changes)
            return (Estimate(number, number, number) if paired else UNKNOWN), paired
        if self.quantity in _OF_ALL:
            values = [_OF_ALL[self.quantity](one) for one in results]
            return rate(values), len(values)
        if self.quantity in _MET:
            values = [_MET[self.quantity](one) for one in counted(results, failed=True)]
            return rate(values), len(values)
        if self.quantity in _COUNTED:
            values = [_COUNTED[self.quantity](one) for one in counted(results)]
            return rate(values), len(values)
        values = [value for one in counted(results) if math.isfinite(value := metric(one, self.quantity))]
        return mean(values), len(values)

    def holds(self, value: float) -> bool:
        """Whether a value meets the condition; an unknown one does not."""
        return not math.isnan(value) and _SIGNS[self.sign](value, self.bound)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Condition on one perception.

    Attributes:
        condition: that was checked.
        perception: name in tables.
        found: value with its interval.
        episodes: number of episodes that it is of.
        holds: whether the condition is met.
    """

    condition: Condition
    perception: str
    found: Estimate
    episodes: int
    holds: bool

    @property
    def text(self) -> str:
        """What was found, with its interval."""
        name, (value, low, high) = self.condition.quantity, self.found
        if math.isnan(value):
            return "unknown"
        if name in _CHANGES:
            return f"{value:.0f}"
        scale, unit = (100.0, " %") if name in _SHARES else (1.0, "")
        span = "" if math.isnan(low) else f" [{scale * low:.3g}, {scale * high:.3g}]"
        return f"{scale * value:.3g}{unit}{span}"


def check_conditions(texts: Sequence[str], perceptions: Sequence[str], has_baseline: bool) -> tuple[Condition, ...]:
    """Return the conditions of a command line, before anything is driven.

    Args:
        perceptions: names of the campaign's perceptions.
        has_baseline: whether there are episodes to compare with.

    Raises:
        SettingsError: as `Condition.parse`; a perception is not of the campaign, or changes have no baseline.
    """
    found = tuple(map(Condition.parse, texts))
    for one in found:
        if one.perception and one.perception not in perceptions:
            hint = did_you_mean(one.perception, perceptions)
            raise SettingsError(_wrong("a perception of the campaign", one.perception, hint))
        if one.quantity in _CHANGES and not has_baseline:
            raise SettingsError(_wrong(f"--baseline beside {one.quantity}", "none"))
    return found


def judged(
    conditions: Sequence[Condition], results: Sequence[EpisodeResult], changes: Sequence[Change] = ()
) -> tuple[Verdict, ...]:
    """Return every condition for every perception that it is about, over all its episodes."""
    found = []
    for condition in conditions:
        for name in dict.fromkeys(one.perception for one in results):
            if condition.perception in ("", name):
                own = [one for one in results if one.perception == name]
                value, episodes = condition.estimate(own, [one for one in changes if one.perception == name])
                found.append(Verdict(condition, name, value, episodes, condition.holds(value.value)))
    return tuple(found)


def verdict_table(verdicts: Sequence[Verdict]) -> Table:
    """Table of conditions."""
    rows = [
        (one.condition.text, one.perception, "holds" if one.holds else "fails", str(one.episodes), one.text)
        for one in verdicts
    ]
    return Table.of(("condition", "perception", "", "episodes", "found"), rows, texts=3)


def _wrong(expected: str, found: str, hint: str = "") -> str:
    return complaint("drive", "--fail-under", expected, found, hint)
