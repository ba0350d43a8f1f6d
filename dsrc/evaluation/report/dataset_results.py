"""Results of one dataset, selected from all results of a benchmark."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from dsrc.evaluation.config import Case, Footnote
from dsrc.evaluation.results import CLEAN, Row
from dsrc.evaluation.runner import BenchmarkResult, CaseResult, TrainedDetector
from dsrc.models.settings import ModelSettings
from dsrc.tables.table import Stat
from sensors.corruptions import CORRUPTIONS, EVERYONE, Family
from sim.radio import IDEAL

PAPER_SEVERITY = 3
NAMES = ("ap_bev_50", "ap_bev_70")


@dataclass(frozen=True, slots=True)
class DatasetResults:
    """Results of one dataset, clean and under the corruptions of one family.

    Attributes:
        dataset: name of the dataset.
        trained: detectors of each method, in the order of the lines.
        entries: the results.
        severity: of the tables.
        channel: of the tables.
        family: of the corruptions.
        starts: initial weights of the trainings by method, where known.
        notes: footnotes.
        corrupted_agents: agents whose sweeps are corrupted.
    """

    dataset: str
    trained: dict[str, list[TrainedDetector]]
    entries: tuple[CaseResult, ...]
    severity: int
    channel: str
    family: Family = "physical"
    starts: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[Footnote, ...] = ()
    corrupted_agents: str = EVERYONE

    @classmethod
    def of(cls, result: BenchmarkResult, dataset: str, family: Family | None = None) -> "DatasetResults":
        """Select the results of a dataset and a family, by default the first."""
        plan = result.plan
        family = family or plan.family[0]
        rows = (entry for entry in result.entries if entry.case.dataset == dataset)
        return cls(
            dataset,
            result.trained,
            tuple(
                entry for entry in rows if entry.case.condition.family == family or not entry.case.condition.severity
            ),
            PAPER_SEVERITY if PAPER_SEVERITY in plan.severity or not plan.severity else plan.severity[0],
            IDEAL if IDEAL in plan.channel else plan.channel[0],
            family,
            {method.name: method.start for method in plan.methods if method.start},
            plan.notes,
            plan.corrupted_agents,
        )

    @property
    def titled(self) -> str:
        """Title of the dataset; it marks published corruptions, and those of some agents alone."""
        published = "" if self.family == "physical" else ", corruptions as published"
        some = "" if self.corrupted_agents == EVERYONE else f", corrupted: {self.corrupted_agents}"
        return f"{self.dataset}{published}{some}"

    @property
    def level(self) -> str:
        """Severity and models of the corruptions, for notes."""
        models = "" if self.family == "physical" else " of the published models"
        return f"Severity {self.severity}{models}."

    def mark(self, method: str) -> str:
        """Footnote marks of a method; "" for none."""
        return "".join(mark for mark, note in zip(_marks(), self.notes, strict=False) if method in note.methods)

    def marked(self, label: str, method: str) -> str:
        """Label of a method with its footnote marks."""
        return f"{label} {self.mark(method)}".rstrip()

    def footnotes(self, methods: Sequence[str]) -> tuple[str, ...]:
        """Footnotes of methods, in their order."""
        marked = zip(_marks(), self.notes, strict=False)
        return tuple(f"{mark} {note.text}" for mark, note in marked if set(methods) & set(note.methods))

    @property
    def settings(self) -> dict[str, ModelSettings]:
        """Settings of each method, without detectors of one's own."""
        found = {name: several[0].settings for name, several in self.trained.items()}
        return {name: settings for name, settings in found.items() if isinstance(settings, ModelSettings)}

    def kinds(self) -> list[str]:
        """Kinds of corruption, then texts of faults, in their order."""
        found = dict.fromkeys(entry.case.condition.kind for entry in self.entries)
        return [kind for kind in found if kind != CLEAN]

    def corruptions(self) -> list[str]:
        """Kinds of corruption, of which the summaries are."""
        return [kind for kind in self.kinds() if kind in CORRUPTIONS]

    def found(
        self,
        method: str,
        kind: str = CLEAN,
        *,
        severity: int | None = None,
        channel: str | None = None,
        agents: int | None = None,
        pose_error: float = 0.0,
        delay_s: float = 0.0,
        loss: float = 0.0,
    ) -> list[CaseResult]:
        """Results of a method, one per training in their order."""
        level = severity or self.severity
        wanted = (method, kind, channel or self.channel, agents, pose_error, delay_s, loss)
        return [
            entry
            for entry in self.entries
            if _place(entry.case) == wanted and entry.case.condition.severity in (0, level)
        ]

    def rows(self, method: str, kind: str = CLEAN, **picks: Any) -> list[Row]:
        """Rows of a method, one per training in their order; `picks` as in `found`."""
        return [entry.row for entry in self.found(method, kind, **picks)]

    def ap(self, rows: Sequence[Row], names: Sequence[str] = NAMES) -> tuple[Stat, ...]:
        """Average precisions over rows."""
        return tuple(Stat.of([row.metrics.get(name, math.nan) for row in rows]) for name in names)

    def summary(
        self, method: str, formula: Callable[[float, dict[str, float]], float], names: Sequence[str] = NAMES
    ) -> tuple[Stat, ...]:
        """Mean and spread over trainings of `mce` or `mean_ap`, computed for each training by itself."""
        clean = self.rows(method)
        corrupted = {kind: self.rows(method, kind) for kind in self.corruptions()}
        if not corrupted:
            return tuple(Stat(math.nan) for _ in names)
        return tuple(
            Stat.of(
                [
                    formula(row.metrics[name], {kind: rows[i].metrics[name] for kind, rows in corrupted.items()})
                    for i, row in enumerate(clean)
                ]
            )
            for name in names
        )


def _marks() -> Iterator[str]:
    """Yield footnote marks: four signs, then each of them twice, and so on."""
    return (mark * times for times in count(1) for mark in "†‡.¶")


def _place(case: Case) -> tuple[object, ...]:
    return (
        *(case.method, case.condition.kind, case.channel, case.agents),
        *(case.pose_error, case.delay_s, case.loss),
    )
