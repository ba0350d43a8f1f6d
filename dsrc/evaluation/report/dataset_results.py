"""Results of one dataset, selected from those of a benchmark.

A method is identified by its settings: its fusion, and the parts of DSRC (SDD, PCP, REC) that trained it. So a table
finds its methods under any name, and lists the missing ones.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from msgspec.structs import replace

from dsrc.evaluation.config import Case, Footnote
from dsrc.evaluation.figures.style import Style, styles_of
from dsrc.evaluation.results import CLEAN, Row
from dsrc.evaluation.runner import BenchmarkResult, CaseResult, TrainedDetector
from dsrc.evaluation.table import Stat
from dsrc.models.settings import ModelSettings
from sensors.corruptions import EVERYONE, Family
from sim.radio import IDEAL

PAPER_SEVERITY = 3
NAMES = ("ap_bev_50", "ap_bev_70")
PLAIN, WHOLE = (False, False, False), (True, True, True)
_STYLED = (
    "attention", "none", "late", "max", "v2vnet", "v2xvit", "cobevt", "where2comm", "coalign", "ermvp", "mrcnet",
    "early", "max_map",
)  # fmt: skip
"""Fusions in the order of their styles, those of the paper first: there are fewer colours than fusions."""


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
        who: agents whose sweeps are corrupted.
    """

    dataset: str
    trained: dict[str, list[TrainedDetector]]
    entries: tuple[CaseResult, ...]
    severity: int
    channel: str
    family: Family = "physical"
    starts: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[Footnote, ...] = ()
    who: str = EVERYONE

    @classmethod
    def of(cls, result: BenchmarkResult, dataset: str, family: Family | None = None) -> "DatasetResults":
        """Select the results of a dataset and a family, by default the first."""
        plan = result.plan
        family = family or plan.families[0]
        rows = (entry for entry in result.entries if entry.case.dataset == dataset)
        return cls(
            dataset,
            result.trained,
            tuple(entry for entry in rows if entry.case.condition.family == family or _is_clean(entry)),
            PAPER_SEVERITY if PAPER_SEVERITY in plan.severities or not plan.severities else plan.severities[0],
            IDEAL if IDEAL in plan.channels else plan.channels[0],
            family,
            {method.name: method.start for method in plan.methods if method.start},
            plan.notes,
            plan.who,
        )

    @property
    def titled(self) -> str:
        """Title of the dataset; it marks published corruptions, and those of some agents alone."""
        published = "" if self.family == "physical" else ", corruptions as published"
        return f"{self.dataset}{published}{'' if self.who == EVERYONE else f', corrupted: {self.who}'}"

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
        """Settings of each method."""
        return {name: several[0].settings for name, several in self.trained.items()}

    def kinds(self) -> list[str]:
        """Kinds of corruption, in their order."""
        found = dict.fromkeys(entry.case.condition.kind for entry in self.entries)
        return [kind for kind in found if kind != CLEAN]

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
        level = 0 if kind == CLEAN else severity or self.severity
        wanted = (method, kind, level, channel or self.channel, agents, pose_error, delay_s, loss)
        return [entry for entry in self.entries if _place(entry.case) == wanted]

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
        corrupted = {kind: self.rows(method, kind) for kind in self.kinds()}
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

    def variant(self, like: ModelSettings, parts: tuple[bool, bool, bool]) -> str | None:
        """First method that differs from `like` in (SDD, PCP, REC) alone."""
        sdd, pcp, rec = parts
        wanted = replace(like, sdd=sdd, pcp=pcp, rec=rec)
        return next((name for name, settings in self.settings.items() if settings == wanted), None)

    def whole(self, fusion: str) -> str | None:
        """First method of a fusion with all parts of DSRC."""
        return self._first(fusion, WHOLE)

    def plain(self, fusion: str) -> str | None:
        """First method of a fusion without parts of DSRC; preferably one that equals `whole` otherwise."""
        whole = self.whole(fusion)
        alike = None if whole is None else self.variant(self.settings[whole], PLAIN)
        return alike or self._first(fusion, PLAIN)

    def _first(self, fusion: str, parts: tuple[bool, bool, bool]) -> str | None:
        return next((n for n, s in self.settings.items() if s.fusion == fusion and parts_of(s) == parts), None)


def _is_clean(entry: CaseResult) -> bool:
    return entry.case.condition.kind == CLEAN


def _marks() -> Iterator[str]:
    """Yield footnote marks: four signs, then each of them twice, and so on."""
    return (mark * times for times in count(1) for mark in "†‡.¶")


def _place(case: Case) -> tuple[object, ...]:
    condition = case.condition
    return (
        *(case.method, condition.kind, condition.severity, case.channel, case.agents),
        *(case.pose_error, case.delay_s, case.loss),
    )


def parts_of(settings: ModelSettings) -> tuple[bool, bool, bool]:
    """Parts (SDD, PCP, REC) that trained a detector."""
    return settings.sdd, settings.pcp, settings.rec


def compared_methods(results: DatasetResults) -> list[str]:
    """Methods of Table 1: all but DSRC with only some of its parts, which Table 2 has."""
    return [name for name, settings in results.settings.items() if parts_of(settings) in (PLAIN, WHOLE)]


def trained_methods(results: DatasetResults) -> list[str]:
    """Methods of Table 1 without variants in use, which have another's weights and almost its place in a figure."""
    return [name for name in compared_methods(results) if not results.trained[name][0].use]


def method_styles(results: DatasetResults) -> dict[str, Style]:
    """Styles of all methods: DSRC and every plain fusion have the same in all benchmarks, whatever else is there."""
    plain = [results.plain(fusion) or fusion for fusion in _STYLED]
    return styles_of([results.whole("attention") or "DSRC", *plain, *results.trained])


def averaged_methods(results: DatasetResults) -> list[str]:
    """Methods averaged in Figure 4: neither with changed settings nor, as in Tables 3 and 4, DSRC around them.

    Of methods that differ in their training alone, such as its clouds or a head for directions, the first.
    """
    alike = {name: replace(settings, direction=False) for name, settings in results.settings.items()}
    first = {settings: name for name, settings in reversed(alike.items())}
    return [
        name
        for name in trained_methods(results)
        if results.trained[name][0].agents is None
        and first[alike[name]] == name
        and (parts_of(results.settings[name]) == PLAIN or results.settings[name].fusion == "attention")
    ]
