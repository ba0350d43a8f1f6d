"""Episodes of a campaign beside those of an earlier one, its baseline: what is fixed, broken and unchanged."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.run import read_results
from dsrc.closed_loop.metrics.comparison import collided
from dsrc.closed_loop.metrics.statistics import paired_rates
from dsrc.closed_loop.report.cells import condition, scenario_title, share
from dsrc.closed_loop.types import Outcome
from dsrc.tables.table import Table
from sim.errors import DataError, complaint

Kind = Literal["fixed", "broken", "unchanged", "uncounted", "new", "gone"]

_MADE = ("road_user", "detectable", "outcome", "message", "key", "metrics")
"""Fields of a result that its episode made; the others say which episode it is."""
_SETTINGS = tuple(name for name in EpisodeResult.__struct_fields__ if name not in _MADE)
_BETTER = {Outcome.ARRIVED.value: 2, Outcome.TIMEOUT.value: 1, Outcome.DESYNCHRONISED.value: -1}
"""Order of the outcomes; all others are failures, 0, and an encounter that was not met is none of them."""


@dataclass(frozen=True, slots=True)
class Change:
    """Episode beside the same one of the baseline.

    Attributes:
        kind: `fixed` or `broken` where the outcome is better or worse: an arrival is better than a time out, which is
            better than any failure; `uncounted` where one of both never met its encounter; `new` and `gone` where only
            this run, or only the baseline, has it.
        now: result of this run; None where it is gone.
        before: result of the baseline; None where it is new.
    """

    kind: Kind
    now: EpisodeResult | None
    before: EpisodeResult | None

    @property
    def one(self) -> EpisodeResult:
        """Result of this run, else of the baseline."""
        found = self.now or self.before
        assert found is not None
        return found

    @property
    def perception(self) -> str:
        """Name of its perception in tables."""
        return self.one.perception

    @property
    def paired(self) -> bool:
        """Whether both runs count the episode."""
        return self.kind in ("fixed", "broken", "unchanged")


def read_baseline(path: Path) -> list[EpisodeResult]:
    """Return the results of an earlier run, of any version of the code: its results.csv, or its folder.

    Raises:
        DataError: the file is no results.csv, or has two results of one episode.
    """
    file = path / "results.csv" if path.is_dir() else path
    found = list(read_results([file], whole=False, field="baseline").values())
    counts = Counter(map(_settings, found))
    if repeated := [one for one in found if counts[_settings(one)] > 1]:
        twice = f"two of {episode_name(repeated[0])}"
        raise DataError(complaint(file, "baseline", "one result of each episode", twice))
    return found


def changes(results: Sequence[EpisodeResult], baseline: Sequence[EpisodeResult]) -> list[Change]:
    """Return the episodes of a run beside those of its baseline of equal settings and seed, in the run's order."""
    before = {_settings(one): one for one in baseline}
    found = [_change(one, before.pop(_settings(one), None)) for one in results]
    return [*found, *(Change("gone", None, one) for one in before.values())]


def _change(now: EpisodeResult, before: EpisodeResult | None) -> Change:
    if before is None:
        return Change("new", now, None)
    was, is_now = (_BETTER.get(one.outcome, 0) for one in (before, now))
    if min(was, is_now) < 0:
        return Change("uncounted", now, before)
    return Change("unchanged" if was == is_now else "fixed" if is_now > was else "broken", now, before)


def _settings(one: EpisodeResult) -> tuple[object, ...]:
    return tuple(getattr(one, name) for name in _SETTINGS)


def episode_name(one: EpisodeResult) -> str:
    """Return which episode a result is of, in a few words."""
    return f"{scenario_title(one.scenario)}, {one.perception}, {condition(one)}, seed {one.seed}"


def change_table(found: Sequence[Change]) -> Table:
    """Table of the changes, a row per perception and condition."""
    groups: dict[tuple[str, str], list[Change]] = {}
    for one in found:
        groups.setdefault((one.perception, condition(one.one)), []).append(one)
    kinds = ("fixed", "broken", "unchanged", "uncounted", "new", "gone")
    heads = ("perception", "condition", *kinds, "crashes more", "p")
    rows = []
    for (perception, title), group in groups.items():
        counts = Counter[str](one.kind for one in group)
        paired = [(one.now, one.before) for one in group if one.paired]
        both = [(collided(a), collided(b)) for a, b in paired if a is not None and b is not None]
        # A failed perception has no crash, and is no episode without one.
        known = [(a, b) for a, b in both if a == a and b == b]
        test = paired_rates([a for a, _ in known], [b for _, b in known])
        p_value = "" if not known else "< 0.001" if test.p_value < 0.001 else f"{test.p_value:.3f}"
        numbers = (str(counts[kind]) for kind in kinds)
        rows.append((perception, title, *numbers, share(test.difference, signed=True), p_value))
    table = Table.of(heads, rows, texts=2)
    narrow = tuple(replace(one, terminal=one.title not in ("new", "gone", "p")) for one in table.columns)
    return replace(table, columns=narrow)


def changed_table(found: Sequence[Change], most: int = 20) -> Table:
    """Table of the episodes that are broken and fixed, the broken ones first; at most so many rows of each."""
    rows = []
    for kind in ("broken", "fixed"):
        for one in [one for one in found if one.kind == kind][:most]:
            assert one.now is not None
            assert one.before is not None
            title, ends = scenario_title(one.now.scenario), (one.before.outcome, one.now.outcome)
            rows.append((title, one.perception, condition(one.now), *ends, kind, one.now.seed))
    heads = ("scenario", "perception", "condition", "before", "now", "", "seed")
    return Table.of(heads, rows, texts=6)
