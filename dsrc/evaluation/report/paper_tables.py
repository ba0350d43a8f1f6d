"""Tables of the paper, made of the rows of a benchmark.

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
from dsrc.evaluation.metrics.ap import metric_name
from dsrc.evaluation.metrics.robustness import mce, mean_ap
from dsrc.evaluation.results import CLEAN, Row, condition_title
from dsrc.evaluation.runner import VISIBILITY, BenchmarkResult, CaseResult, TrainedDetector
from dsrc.evaluation.table import Column, ResultTable, Stat, TableRow
from dsrc.models.settings import ModelSettings
from sensors.corruptions import EVERYONE, Family
from sim.radio import IDEAL

PAPER_SEVERITY = 3
NAMES = ("ap_bev_50", "ap_bev_70")
OPENCOOD_NAMES = (metric_name("bev", 0.5, opencood=True), metric_name("bev", 0.7, opencood=True))

_AP = "Average precision in bird's-eye view at IoU 0.5 / 0.7, %"
_PLAIN, _WHOLE = (False, False, False), (True, True, True)


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
        return self._first(fusion, _WHOLE)

    def plain(self, fusion: str) -> str | None:
        """First method of a fusion without parts of DSRC; preferably one that equals `whole` otherwise."""
        whole = self.whole(fusion)
        alike = None if whole is None else self.variant(self.settings[whole], _PLAIN)
        return alike or self._first(fusion, _PLAIN)

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
    return [name for name, settings in results.settings.items() if parts_of(settings) in (_PLAIN, _WHOLE)]


def averaged_methods(results: DatasetResults) -> list[str]:
    """Methods averaged in Figure 4: neither with changed settings nor, as in Tables 3 and 4, DSRC around them.

    Of methods with equal settings, such as those trained on other clouds, the first.
    """
    first = {settings: name for name, settings in reversed(results.settings.items())}
    return [
        name
        for name in compared_methods(results)
        if not results.trained[name][0].use
        and results.trained[name][0].agents is None
        and first[results.settings[name]] == name
        and (parts_of(results.settings[name]) == _PLAIN or results.settings[name].fusion == "attention")
    ]


def table_1(results: DatasetResults, *, opencood: bool = False) -> ResultTable:
    """Table 1: clean and corrupted frames, mCE and mean AP, bytes and time.

    Args:
        results: of the dataset.
        opencood: detections sorted inside their frame only, as in the paper's tables.
    """
    names, kinds = OPENCOOD_NAMES if opencood else NAMES, results.kinds()
    columns = [Column(condition_title(kind).capitalize()) for kind in (CLEAN, *kinds)]
    columns += [Column("mCE", better="low"), Column("mAP")]
    columns += [
        Column("kB / frame", ("",), better="", scale=1e-3),
        Column("ms / frame", ("",), better="", scale=1e3, digits=0),
    ]
    lines = []
    for method in compared_methods(results):
        clean = results.rows(method)
        cells = [results.ap(clean, names), *(results.ap(results.rows(method, kind), names) for kind in kinds)]
        cells += [results.summary(method, mce, names), results.summary(method, mean_ap, names)]
        cells += [
            (Stat.of([row.bytes_per_frame for row in clean if row.bytes_per_frame is not None]),),
            (Stat.of([row.seconds_per_frame for row in clean if row.seconds_per_frame is not None]),),
        ]
        words = (results.starts.get(method, ""),) if results.starts else ()
        lines.append(TableRow(method, tuple(cells), results.mark(method), words))
    order = (
        "detections sorted inside each frame, as OpenCOOD and the paper do" if opencood else "sorted over all frames"
    )
    note = (
        f"{_AP}; {order}. {results.level} mCE: share of the clean AP lost, less is better; mAP: mean over "
        f"clean and corrupted frames. kB: what all collaborators send for a frame, clean."
        f"{_bytes(results, compared_methods(results))} ms: median time of a detection."
        f"{sample_note(results, compared_methods(results))}"
    )
    name = "table_1_opencood" if opencood else "table_1"
    title = f"Table 1{', sorted inside frames' if opencood else ''}. Clean and corrupted frames, {results.titled}"
    words, footnotes = ("Start",) if results.starts else (), results.footnotes(compared_methods(results))
    return ResultTable(name, title, note, "Method", tuple(columns), tuple(lines), words, footnotes)


def table_2(results: DatasetResults) -> ResultTable | str:
    """Table 2, DSRC and its parts, or a text that names the missing methods."""
    whole = results.whole("attention")
    if whole is None:
        return _missing_methods("Table 2", "a method with attention, SDD, PCP and REC (dsrc)")
    like, lines, found, missing = results.settings[whole], [], [], []
    for parts in (_PLAIN, (True, False, False), (False, True, False), (True, True, False), _WHOLE):
        method = results.variant(like, parts)
        label = " + ".join(part for part, there in zip(("SDD", "PCP", "REC"), parts, strict=True) if there) or "none"
        if method is None:
            missing.append(label)
            continue
        found.append(method)
        clean = results.ap(results.rows(method))
        cells = (clean, results.summary(method, mean_corrupted), results.summary(method, mean_ap))
        lines.append(TableRow(label, cells, results.mark(method)))
    if len(lines) < 2:
        return _missing_methods("Table 2", f"'{whole}' with other parts: {', '.join(missing)}")
    columns = (Column("Clean"), Column("Mean of the corruptions"), Column("Mean with clean"))
    without = f" Left out, for want of a method: {', '.join(missing)}." if missing else ""
    note = (
        f"{_AP}. {results.level} The paper's numbers agree with its mean with clean, whatever its caption "
        f"says.{sample_note(results, found)}{without}"
    )
    title = f"Table 2. Parts of DSRC, {results.titled}"
    return ResultTable("table_2", title, note, "Parts", columns, tuple(lines), footnotes=results.footnotes(found))


def table_3(results: DatasetResults) -> ResultTable | str:
    """Table 3, DSRC around fusion by maximum and by attention, or a text that names the missing methods."""
    return _pairs(
        results,
        "Table 3",
        "DSRC around another fusion",
        (("max", "Maximum", "f-cooper, dsrc-max"), ("attention", "Attention", "attfuse, dsrc")),
    )


def table_4(results: DatasetResults) -> ResultTable | str:
    """Table 4, DSRC for a single vehicle, or a text that names the missing methods."""
    return _pairs(
        results, "Table 4", "A single vehicle", (("none", "No collaboration", "no-collaboration, dsrc-alone"),)
    )


def _pairs(
    results: DatasetResults, title: str, what: str, fusions: Sequence[tuple[str, str, str]]
) -> ResultTable | str:
    """Table of conditions over pairs of methods, without and with DSRC."""
    columns, methods, missing = [], [], []
    for fusion, label, wanted in fusions:
        pair = results.plain(fusion), results.whole(fusion)
        if pair[0] is None or pair[1] is None:
            missing.append(wanted)
            continue
        titles = (results.marked(label, pair[0]), results.marked(f"{label} + DSRC", pair[1]))
        columns += [Column(text, better="") for text in titles]  # the best of a line matters, not of a column
        methods += [name for name in pair if name is not None]
    if not methods:
        return _missing_methods(title, "; ".join(missing))
    lines = [
        TableRow(
            condition_title(kind).capitalize(), tuple(results.ap(results.rows(method, kind)) for method in methods)
        )
        for kind in (CLEAN, *results.kinds())
    ]
    lines.append(TableRow("mCE", tuple(results.summary(method, mce) for method in methods)))
    lines.append(TableRow("mAP", tuple(results.summary(method, mean_ap) for method in methods)))
    without = f" Left out, for want of methods: {'; '.join(missing)}." if missing else ""
    note = f"{_AP}. {results.level}{sample_note(results, methods)}{without}"
    name = title.lower().replace(" ", "_")
    title, footnotes = f"{title}. {what}, {results.titled}", results.footnotes(methods)
    return ResultTable(name, title, note, "Condition", tuple(columns), tuple(lines), footnotes=footnotes)


@dataclass(frozen=True, slots=True)
class SweepAxis:
    """Swept quantity of a benchmark.

    Attributes:
        name: of the table.
        title: of the table.
        label: with its unit.
        values: in their order: text, and arguments of `DatasetResults.rows` that select the rows.
    """

    name: str
    title: str
    label: str
    values: tuple[tuple[str, dict[str, object]], ...]

    @property
    def places(self) -> list[float]:
        """Places of the values on the axis: of numbers the numbers, of names 0, 1, 2, ..."""
        numbers = [picks.get(self.name) for _, picks in self.values]
        return [float(x) if isinstance(x, int | float) else row for row, x in enumerate(numbers)]


def axes_of(result: BenchmarkResult) -> list[SweepAxis]:
    """Swept quantities of a benchmark."""
    plan, sweeps = result.plan, result.plan.sweeps
    still: dict[str, object] = {"channel": IDEAL}
    axes = [
        SweepAxis(
            "agents",
            "Figure 7. Number of agents",
            "agents, the ego included",
            tuple((str(n), {**still, "agents": n}) for n in sorted(sweeps.agents)),
        )
    ]
    for name, title, label, values in (
        ("pose_error", "Errors of the pose", "standard deviation of the pose, m and degrees", sweeps.pose_error),
        ("delay_s", "Delay", "delay, s", sweeps.delay_s),
        ("loss", "Loss", "share of packets lost", sweeps.loss),
    ):
        shown = sorted({0.0, *values}) if values else []
        axes.append(SweepAxis(name, title, label, tuple((f"{v:g}", {**still, name: v}) for v in shown)))
    axes.append(
        SweepAxis("channels", "Channels", "channel", tuple((name, {"channel": name}) for name in plan.channels))
    )
    return [axis for axis in axes if len(axis.values) > 1]


def sweep_table(results: DatasetResults, axis: SweepAxis) -> ResultTable:
    """Table of methods over the values of a swept quantity, in clean frames."""
    columns = [Column(text) for text, _ in axis.values]
    if axis.name == "channels":
        columns += [Column(f"{text}, kB / age ms / heard %", ("kB", "ms", "%"), "", 1.0, 0) for text, _ in axis.values]
    lines, shown = [], []
    for method in results.settings:
        found = [results.rows(method, **picks) for _, picks in axis.values]  # type: ignore[arg-type]
        cells = [results.ap(rows) for rows in found]
        if all(math.isnan(cell[0].mean) for cell in cells[1:]):
            continue
        shown.append(method)
        cells += [_air(rows) for rows in found] if axis.name == "channels" else []
        lines.append(TableRow(method, tuple(cells), results.mark(method)))
    sent = _bytes(results, shown) if axis.name == "channels" else ""
    note = f"{_AP}, clean frames, over: {axis.label}.{sent}{sample_note(results, shown)}"
    title, footnotes = f"{axis.title}, {results.dataset}", results.footnotes(shown)
    return ResultTable(axis.name, title, note, "Method", tuple(columns), tuple(lines), footnotes=footnotes)


def _air(rows: Sequence[Row]) -> tuple[Stat, ...]:
    """Traffic: kB sent per frame, age of used messages, ms, and share of senders received, %."""
    return tuple(
        Stat.of([math.nan if (value := getattr(row, name)) is None else scale * value for row in rows])
        for name, scale in (("bytes_per_frame", 1e-3), ("message_age_s", 1e3), ("heard", 100.0))
    )


def severity_table(results: DatasetResults, severities: Sequence[int]) -> ResultTable:
    """Table of mean AP over the corruptions at each severity."""
    columns = [Column(CLEAN.capitalize()), *(Column(f"severity {level}") for level in severities)]
    lines = []
    for method in compared_methods(results):
        cells = [results.ap(results.rows(method))]
        for level in severities:
            groups = [results.rows(method, kind, severity=level) for kind in results.kinds()]
            trainings = zip(*groups, strict=True)
            means = [
                [sum(row.metrics[name] for row in rows) / len(rows) for name in NAMES] for rows in trainings if rows
            ]
            cells.append(tuple(Stat.of([pair[k] for pair in means]) for k in range(2)))
        lines.append(TableRow(method, tuple(cells), results.mark(method)))
    note = f"{_AP}, mean of the corruptions.{sample_note(results, compared_methods(results))}"
    title, footnotes = f"Severity, {results.titled}", results.footnotes(compared_methods(results))
    return ResultTable("severity", title, note, "Method", tuple(columns), tuple(lines), footnotes=footnotes)


def visibility_table(results: DatasetResults) -> ResultTable | str:
    """Table of AP by visibility of the boxes from the ego, or a text where it is unknown."""
    if not any(name.endswith("_hidden") for entry in results.entries for name in entry.row.metrics):
        return f"Visibility is left out: unknown in {results.dataset}."
    columns = [Column(f"{name}, {low:.0%} to {min(high, 1.0):.0%}") for name, (low, high) in VISIBILITY.items()]
    lines = [
        TableRow(
            method,
            tuple(results.ap(results.rows(method), [f"{name}_{part}" for name in NAMES]) for part in VISIBILITY),
            results.mark(method),
        )
        for method in compared_methods(results)
    ]
    note = (
        f"{_AP}, clean frames, of boxes by the share of the ego's rays on them that nothing else stops."
        f"{sample_note(results, compared_methods(results))}"
    )
    title, footnotes = f"By what the ego sees, {results.dataset}", results.footnotes(compared_methods(results))
    return ResultTable("visibility", title, note, "Method", tuple(columns), tuple(lines), footnotes=footnotes)


def mean_corrupted(clean: float, by_corruption: dict[str, float]) -> float:
    """Mean average precision over the corruptions, without clean frames."""
    return sum(by_corruption.values()) / len(by_corruption)


def corruption_tables(results: DatasetResults, severities: Sequence[int]) -> list[ResultTable | str]:
    """Tables of one family of corruptions; a text in place of a table without its methods."""
    sheets: list[ResultTable | str] = [
        table_1(results),
        table_1(results, opencood=True),
        table_2(results),
        table_3(results),
    ]
    sheets.append(table_4(results))
    if len(severities) > 1 and results.kinds():
        sheets.append(severity_table(results, sorted(severities)))
    return sheets


def clean_tables(results: DatasetResults, axes: Sequence[SweepAxis]) -> list[ResultTable | str]:
    """Tables of clean frames, the same for all families."""
    return [visibility_table(results), *(sweep_table(results, axis) for axis in axes)]


def _missing_methods(table: str, what: str) -> str:
    return f"{table} is left out: it needs {what}."


def sample_note(results: DatasetResults, methods: Sequence[str], *, spread: bool = True) -> str:
    """Note on a table's sample: frames and boxes, recipe and range, trainings.

    Args:
        results: of the dataset.
        methods: of the table.
        spread: explain ± where a method has several trainings.
    """
    if not methods:
        return ""
    rows = [row for method in methods for row in results.rows(method)[:1]]
    counts = dict.fromkeys(f"{row.frames} frames with {row.truth} boxes" for row in rows)
    several = spread and any(len(results.trained[method]) > 1 for method in methods)
    about = " ± is the standard deviation between trainings." if several else ""
    recipes = _texts_by_method(methods, {method: _recipe(results.trained[method]) for method in methods})
    seeds = _texts_by_method(
        methods,
        {method: ", ".join(_or_unknown(one.seed) for one in results.trained[method]) for method in methods},
    )
    return f" {' or '.join(counts)}. Recipe and range: {recipes}. Seeds of the trainings: {seeds}.{about}"


def _recipe(trained: Sequence[TrainedDetector]) -> str:
    x0, y0, _, x1, y1, _ = trained[0].settings.grid.range_m
    names = dict.fromkeys(one.recipe or "not known" for one in trained)
    return f"{' or '.join(names)}, x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m"


def _or_unknown(seed: int | None) -> str:
    return "not known" if seed is None else str(seed)


def _texts_by_method(methods: Sequence[str], texts: dict[str, str]) -> str:
    """Texts with their methods, the most frequent one last and for the others."""
    groups: dict[str, list[str]] = {}
    for method in methods:
        groups.setdefault(texts[method], []).append(method)
    *fewer, usual = sorted(groups, key=lambda text: len(groups[text]))
    parts = [f"{text} ({', '.join(groups[text])})" for text in fewer]
    return "; ".join([*parts, f"{usual} (the others)" if fewer else usual])


def _bytes(results: DatasetResults, methods: Sequence[str]) -> str:
    """Note on methods whose bytes are counted in a way of their own."""
    special = {
        "where2comm": "is an upper bound: the whole first scale, of which it sends a part",
        "late": "is of the objects of the ground truth that a sender has points on, not of its detections",
    }
    notes = [f" That of {name} {special[f]}." for name in methods if (f := results.settings[name].fusion) in special]
    return "".join(notes)
