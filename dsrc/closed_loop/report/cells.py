"""Cells of a campaign's tables: episodes by perception and condition, and how their numbers are written."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.metrics.comparison import collided, counted, metric
from dsrc.closed_loop.metrics.statistics import Estimate, mean, rate
from dsrc.closed_loop.types import FAILED, Outcome
from dsrc.tables.table import Column
from sim.radio import IDEAL

COLUMNS = tuple(map(Column, ("episodes", "crashed", "at fault", "stuck", "lost", "failed", "score", "progress")))
"""Columns of `condition_cells`."""
HARSH_MPS2 = 4.0
"""Braking that is harsh, m/s2: nuPlan's bound of comfort is 4.05."""


def groups(results: Sequence[EpisodeResult]) -> list[tuple[str, str, list[EpisodeResult]]]:
    """Return results by perception and condition, in the order of their first appearance."""
    found: dict[tuple[str, str], list[EpisodeResult]] = {}
    for perception in dict.fromkeys(one.perception for one in results):
        for one in (one for one in results if one.perception == perception):
            found.setdefault((perception, condition(one)), []).append(one)
    return [(*key, group) for key, group in found.items()]


def scenario_title(name: str) -> str:
    """Return the title of a scenario by its name or path."""
    path = Path(name)
    return (path.parent if path.name == "scenario.toml" else path).name


def condition(one: EpisodeResult) -> str:
    """Return the title of an episode's corruption or faults, and of its channel: `clean` with neither."""
    if one.channel == IDEAL:
        return one.title
    return one.channel if one.clean else f"{one.title}, {one.channel}"


def condition_cells(group: Sequence[EpisodeResult]) -> tuple[str, ...]:
    """Return the numbers of a perception under a condition."""
    met, ends = counted(group), Counter(one.outcome for one in group)
    return (
        str(len(group)),
        share(rate([collided(one) for one in met])),
        str(sum(bool(collided(one)) and metric(one, "at_fault") == 1.0 for one in met)),
        *(str(ends[end.value]) for end in (Outcome.STUCK, Outcome.DESYNCHRONISED)),
        str(sum(ends[end.value] for end in FAILED)),
        score(mean([metric(one, "driving_score_2_1") for one in met])),
        percent(mean([metric(one, "completion") for one in met]).value),
    )


def share(found: Estimate, signed: bool = False) -> str:
    """Return a share with its interval, %; "" if it is unknown."""
    if found.value != found.value:
        return ""
    sign = "+" if signed else ""
    return f"{100 * found.value:{sign}.0f} % [{100 * found.low:.0f}, {100 * found.high:.0f}]"


def score(found: Estimate) -> str:
    """Return a driving score with its interval; "" if it is unknown."""
    if found.value != found.value:
        return ""
    return f"{found.value:.2f}" + ("" if found.low != found.low else f" [{found.low:.2f}, {found.high:.2f}]")


def number(found: Estimate, signed: bool = False) -> str:
    """Return a mean with its interval; "" if it is unknown."""
    if found.value != found.value:
        return ""
    text = f"{found.value:{'+' if signed else ''}.1f}"
    return text + ("" if found.low != found.low else f" [{found.low:.1f}, {found.high:.1f}]")


def percent(value: float) -> str:
    """Return a share, %; "" if it is unknown."""
    return "" if value != value else f"{100 * value:.0f} %"
