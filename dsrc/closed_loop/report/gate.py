"""Gate of a campaign: what a CI run asks of its results, and how it ended, as tables, JUnit's XML and one word."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.report.baseline import Change, change_table, changed_table, changes
from dsrc.closed_loop.report.cells import groups
from dsrc.closed_loop.report.conditions import Condition, Verdict, judged, verdict_table
from dsrc.closed_loop.types import FAILED, Outcome
from dsrc.tables.junit import Case, Suite, junit_xml
from dsrc.tables.table import Table

GATE_NAMES = {
    "gate": "Conditions",
    "baseline": "Against the baseline",
    "changed": "Broken and fixed episodes",
}
"""Titles of the tables of a gate by name."""
_PASSES = (Outcome.ARRIVED.value, Outcome.TIMEOUT.value)


@dataclass(frozen=True, slots=True)
class Gate:
    """What was asked of a campaign's results, judged.

    Attributes:
        verdicts: conditions, each for every perception that it is about.
        changes: episodes beside those of a baseline.
    """

    verdicts: tuple[Verdict, ...] = ()
    changes: tuple[Change, ...] = ()

    @classmethod
    def of(
        cls, result: CampaignResult, conditions: Sequence[Condition], baseline: Sequence[EpisodeResult] | None
    ) -> Self:
        """Judge the results of a campaign.

        Args:
            baseline: results of an earlier campaign; None without one.
        """
        found = () if baseline is None else tuple(changes(result.results, baseline))
        return cls(judged(conditions, result.results, found), found)

    @property
    def holds(self) -> bool:
        """Whether all conditions are met."""
        return all(one.holds for one in self.verdicts)

    def tables(self) -> list[Table]:
        """Tables of the conditions, of the changes, and of the episodes that changed; without empty ones."""
        made = (verdict_table(self.verdicts), change_table(self.changes), changed_table(self.changes))
        named = zip(GATE_NAMES.items(), made, strict=True)
        return [replace(one, name=name, title=title) for (name, title), one in named if one.rows]


NO_GATE = Gate()
"""Nothing was asked."""


def campaign_junit(result: CampaignResult, gate: Gate, told: Mapping[str, str] | None = None) -> bytes:
    """Return JUnit's XML of a campaign: a suite of its conditions, and one of episodes per perception and condition.

    Conditions are the tests that can fail; where there are none the episodes are, each that ended in a failure. An
    episode that never met its encounter is skipped; a perception that failed is an error.

    Args:
        told: further words about an episode by its key, such as the cause of its crash.
    """
    suites = []
    if gate.verdicts:
        suites.append(Suite("conditions", tuple(_condition_case(one) for one in gate.verdicts)))
    kinds = {one.now.key: one.kind for one in gate.changes if one.now is not None}
    for perception, title, group in groups(result.results):
        cases = []
        for one in group:
            changed = f"{kinds[one.key]} against the baseline" if one.key in kinds else ""
            words = [(told or {}).get(one.key, ""), changed]
            case = _episode_case(one, "; ".join(filter(None, words)))
            decides = not gate.verdicts or case.result == "skipped"
            cases.append(case if decides else replace(case, result="passed", message=""))
        suites.append(Suite(f"{perception}, {title}", tuple(cases)))
    return junit_xml(f"dsrc drive {result.plan.name}", suites)


def _condition_case(one: Verdict) -> Case:
    case = Case("dsrc.drive.conditions", f"{one.condition.text}, {one.perception}", output=f"found {one.text}")
    if one.holds:
        return case
    return replace(case, result="failure", message=f"found {one.text} over {one.episodes} episodes")


def _episode_case(one: EpisodeResult, words: str) -> Case:
    """Return the check of an episode: that it arrived, or was still on its way when the time was over."""
    text = ": ".join(filter(None, (one.outcome, one.message or words)))
    driven_s = one.metrics.get("duration_s")
    case = Case(f"dsrc.drive.{one.scenario.replace('.', '_')}", f"seed {one.seed}", output=text, time_s=driven_s)
    if one.outcome == Outcome.DESYNCHRONISED.value:
        return replace(case, result="skipped", message="never met its encounter")
    if one.outcome in FAILED:
        return replace(case, result="error", message=text)
    return case if one.outcome in _PASSES else replace(case, result="failure", message=text)
