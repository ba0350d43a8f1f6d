"""The paper's tables, made of the rows of a benchmark: which methods and conditions each of them holds.

What a method is, its settings say: how it fuses, and which of DSRC's parts (SDD, PCP, REC) trained it. So a table finds
its methods whatever they are called, and says which it lacks.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from msgspec.structs import replace

from dsrc.evaluation.config import Case, Note
from dsrc.evaluation.metrics.ap import metric_name
from dsrc.evaluation.metrics.robustness import mce, mean_ap
from dsrc.evaluation.results import CLEAN, Row, condition_title
from dsrc.evaluation.runner import VISIBILITY, Entry, Outcome, Trained
from dsrc.evaluation.table import Column, Line, Sheet, Stat
from dsrc.models.settings import ModelSettings
from sensors.corruptions import Family
from sim.radio import IDEAL

PAPER_SEVERITY = 3
NAMES = ("ap_bev_50", "ap_bev_70")
OPENCOOD_NAMES = (metric_name("bev", 0.5, opencood=True), metric_name("bev", 0.7, opencood=True))

_AP = "Average precision in bird's-eye view at IoU 0.5 / 0.7, %"
_PLAIN, _WHOLE = (False, False, False), (True, True, True)


@dataclass(frozen=True, slots=True)
class View:
    """The rows of one dataset, clean and under the corruptions of one family, and how the tables ask for them.

    Attributes:
        dataset: its name.
        trained: detectors of each method, in the order of the lines.
        entries: the rows.
        severity: that the tables show.
        channel: likewise.
        family: of the corruptions.
        starts: by method what its trainings began with, of those that say so.
        notes: footnotes.
    """

    dataset: str
    trained: dict[str, list[Trained]]
    entries: tuple[Entry, ...]
    severity: int
    channel: str
    family: Family = "physical"
    starts: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[Note, ...] = ()

    @classmethod
    def of(cls, outcome: Outcome, dataset: str, family: Family | None = None) -> "View":
        """Return the rows of a dataset; of the first family unless another one is asked for."""
        plan = outcome.plan
        family = family or plan.families[0]
        rows = (entry for entry in outcome.entries if entry.case.dataset == dataset)
        return cls(
            dataset,
            outcome.trained,
            tuple(entry for entry in rows if entry.case.condition.family == family or _is_clean(entry)),
            PAPER_SEVERITY if PAPER_SEVERITY in plan.severities or not plan.severities else plan.severities[0],
            IDEAL if IDEAL in plan.channels else plan.channels[0],
            family,
            {method.name: method.start for method in plan.methods if method.start},
            plan.notes,
        )

    @property
    def titled(self) -> str:
        """The dataset, and whether its corruptions are those that were published, for titles."""
        return self.dataset if self.family == "physical" else f"{self.dataset}, corruptions as published"

    @property
    def level(self) -> str:
        """Severity of the corruptions and whose models they are, for notes."""
        models = "" if self.family == "physical" else " of the published models"
        return f"Severity {self.severity}{models}."

    def mark(self, method: str) -> str:
        """Return the marks of a method's footnotes; "" for none."""
        return "".join(mark for mark, note in zip(_marks(), self.notes, strict=False) if method in note.methods)

    def marked(self, label: str, method: str) -> str:
        """Return a label of a method with its marks."""
        return f"{label} {self.mark(method)}".rstrip()

    def footnotes(self, methods: Sequence[str]) -> tuple[str, ...]:
        """Return the footnotes of methods, in their order."""
        marked = zip(_marks(), self.notes, strict=False)
        return tuple(f"{mark} {note.text}" for mark, note in marked if set(methods) & set(note.methods))

    @property
    def settings(self) -> dict[str, ModelSettings]:
        """Settings of each method."""
        return {name: several[0].settings for name, several in self.trained.items()}

    def kinds(self) -> list[str]:
        """Return the corruptions, in their order."""
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
    ) -> list[Entry]:
        """Return what was found of a method, one entry per training in their order."""
        level = 0 if kind == CLEAN else severity or self.severity
        wanted = (method, kind, level, channel or self.channel, agents, pose_error, delay_s, loss)
        return [entry for entry in self.entries if _place(entry.case) == wanted]

    def rows(self, method: str, kind: str = CLEAN, **picks: Any) -> list[Row]:
        """Return the rows of a method, one per training in their order; `picks` as in `found`."""
        return [entry.row for entry in self.found(method, kind, **picks)]

    def ap(self, rows: Sequence[Row], names: Sequence[str] = NAMES) -> tuple[Stat, ...]:
        """Return the average precisions of rows."""
        return tuple(Stat.of([row.metrics.get(name, math.nan) for row in rows]) for name in names)

    def summary(
        self, method: str, formula: Callable[[float, dict[str, float]], float], names: Sequence[str] = NAMES
    ) -> tuple[Stat, ...]:
        """Return `mce` or `mean_ap` over the corruptions, of each training by itself."""
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
        """Return the first method that differs from `like` in (SDD, PCP, REC) alone."""
        sdd, pcp, rec = parts
        wanted = replace(like, sdd=sdd, pcp=pcp, rec=rec)
        return next((name for name, settings in self.settings.items() if settings == wanted), None)

    def whole(self, fusion: str) -> str | None:
        """Return the first method of a fusion with all of DSRC's parts."""
        return self._first(fusion, _WHOLE)

    def plain(self, fusion: str) -> str | None:
        """Return the first method of a fusion without any of DSRC's parts, alike the whole in all else if one is."""
        whole = self.whole(fusion)
        alike = None if whole is None else self.variant(self.settings[whole], _PLAIN)
        return alike or self._first(fusion, _PLAIN)

    def _first(self, fusion: str, parts: tuple[bool, bool, bool]) -> str | None:
        return next((n for n, s in self.settings.items() if s.fusion == fusion and parts_of(s) == parts), None)


def _is_clean(entry: Entry) -> bool:
    return entry.case.condition.kind == CLEAN


def _marks() -> Iterator[str]:
    """Return the marks of footnotes: four daggers and the like, then each of them twice, and so on."""
    return (mark * times for times in count(1) for mark in "†‡.¶")


def _place(case: Case) -> tuple[object, ...]:
    condition = case.condition
    return (
        *(case.method, condition.kind, condition.severity, case.channel, case.agents),
        *(case.pose_error, case.delay_s, case.loss),
    )


def parts_of(settings: ModelSettings) -> tuple[bool, bool, bool]:
    """Return which of SDD, PCP and REC trained a detector."""
    return settings.sdd, settings.pcp, settings.rec


def compared(view: View) -> list[str]:
    """Return the methods of Table 1: all but DSRC with only some of its parts, which are Table 2's."""
    return [name for name, settings in view.settings.items() if parts_of(settings) in (_PLAIN, _WHOLE)]


def averaged(view: View) -> list[str]:
    """Return the methods whose mean Figure 4 shows: none used otherwise or, as in Tables 3 and 4, wrapped.

    Of several that are one method by their settings, as when its clouds were changed for its training, the first.
    """
    first = {settings: name for name, settings in reversed(view.settings.items())}
    return [
        name
        for name in compared(view)
        if not view.trained[name][0].use
        and first[view.settings[name]] == name
        and (parts_of(view.settings[name]) == _PLAIN or view.settings[name].fusion == "attention")
    ]


def table_1(view: View, *, opencood: bool = False) -> Sheet:
    """Return Table 1: clean and corrupted, mCE and mean AP, bytes and time.

    Args:
        view: the rows.
        opencood: precision over detections sorted inside their frame only, as the paper's tables have it.
    """
    names, kinds = OPENCOOD_NAMES if opencood else NAMES, view.kinds()
    columns = [Column(condition_title(kind).capitalize()) for kind in (CLEAN, *kinds)]
    columns += [Column("mCE", better="low"), Column("mAP")]
    columns += [
        Column("kB / frame", ("",), better="", scale=1e-3),
        Column("ms / frame", ("",), better="", scale=1e3, digits=0),
    ]
    lines = []
    for method in compared(view):
        clean = view.rows(method)
        cells = [view.ap(clean, names), *(view.ap(view.rows(method, kind), names) for kind in kinds)]
        cells += [view.summary(method, mce, names), view.summary(method, mean_ap, names)]
        cells += [
            (Stat.of([row.bytes_per_frame for row in clean if row.bytes_per_frame is not None]),),
            (Stat.of([row.seconds_per_frame for row in clean if row.seconds_per_frame is not None]),),
        ]
        words = (view.starts.get(method, ""),) if view.starts else ()
        lines.append(Line(method, tuple(cells), view.mark(method), words))
    order = (
        "detections sorted inside each frame, as OpenCOOD and the paper do" if opencood else "sorted over all frames"
    )
    note = (
        f"{_AP}; {order}. {view.level} mCE: share of the clean AP lost, less is better; mAP: mean over "
        f"clean and corrupted frames. kB: what all collaborators send for a frame, clean."
        f"{_bytes(view, compared(view))} ms: median time of a detection.{made_of(view, compared(view))}"
    )
    name = "table_1_opencood" if opencood else "table_1"
    title = f"Table 1{', sorted inside frames' if opencood else ''}. Clean and corrupted frames, {view.titled}"
    words, footnotes = ("Start",) if view.starts else (), view.footnotes(compared(view))
    return Sheet(name, title, note, "Method", tuple(columns), tuple(lines), words, footnotes)


def table_2(view: View) -> Sheet | str:
    """Return Table 2, DSRC and its parts, or what is missing for it."""
    whole = view.whole("attention")
    if whole is None:
        return _lacks("Table 2", "a method with attention, SDD, PCP and REC (dsrc)")
    like, lines, found, missing = view.settings[whole], [], [], []
    for parts in (_PLAIN, (True, False, False), (False, True, False), (True, True, False), _WHOLE):
        method = view.variant(like, parts)
        label = " + ".join(part for part, there in zip(("SDD", "PCP", "REC"), parts, strict=True) if there) or "none"
        if method is None:
            missing.append(label)
            continue
        found.append(method)
        clean = view.ap(view.rows(method))
        cells = (clean, view.summary(method, mean_corrupted), view.summary(method, mean_ap))
        lines.append(Line(label, cells, view.mark(method)))
    if len(lines) < 2:
        return _lacks("Table 2", f"'{whole}' with other parts: {', '.join(missing)}")
    columns = (Column("Clean"), Column("Mean of the corruptions"), Column("Mean with clean"))
    without = f" Left out, for want of a method: {', '.join(missing)}." if missing else ""
    note = (
        f"{_AP}. {view.level} The paper's numbers agree with its mean with clean, whatever its caption "
        f"says.{made_of(view, found)}{without}"
    )
    title = f"Table 2. Parts of DSRC, {view.titled}"
    return Sheet("table_2", title, note, "Parts", columns, tuple(lines), footnotes=view.footnotes(found))


def table_3(view: View) -> Sheet | str:
    """Return Table 3, DSRC around fusion by the maximum and by attention, or what is missing for it."""
    return _pairs(
        view,
        "Table 3",
        "DSRC around another fusion",
        (("max", "Maximum", "f-cooper, dsrc-max"), ("attention", "Attention", "attfuse, dsrc")),
    )


def table_4(view: View) -> Sheet | str:
    """Return Table 4, DSRC for a single vehicle, or what is missing for it."""
    return _pairs(view, "Table 4", "A single vehicle", (("none", "No collaboration", "no-collaboration, dsrc-alone"),))


def _pairs(view: View, title: str, what: str, fusions: Sequence[tuple[str, str, str]]) -> Sheet | str:
    """Return a table of conditions over pairs of methods, without and with DSRC."""
    columns, methods, missing = [], [], []
    for fusion, label, wanted in fusions:
        pair = view.plain(fusion), view.whole(fusion)
        if pair[0] is None or pair[1] is None:
            missing.append(wanted)
            continue
        titles = (view.marked(label, pair[0]), view.marked(f"{label} + DSRC", pair[1]))
        columns += [Column(text, better="") for text in titles]  # the best of a line, not of a column, matters
        methods += [name for name in pair if name is not None]
    if not methods:
        return _lacks(title, "; ".join(missing))
    lines = [
        Line(condition_title(kind).capitalize(), tuple(view.ap(view.rows(method, kind)) for method in methods))
        for kind in (CLEAN, *view.kinds())
    ]
    lines.append(Line("mCE", tuple(view.summary(method, mce) for method in methods)))
    lines.append(Line("mAP", tuple(view.summary(method, mean_ap) for method in methods)))
    without = f" Left out, for want of methods: {'; '.join(missing)}." if missing else ""
    note = f"{_AP}. {view.level}{made_of(view, methods)}{without}"
    name = title.lower().replace(" ", "_")
    title, footnotes = f"{title}. {what}, {view.titled}", view.footnotes(methods)
    return Sheet(name, title, note, "Condition", tuple(columns), tuple(lines), footnotes=footnotes)


@dataclass(frozen=True, slots=True)
class Axis:
    """A quantity that a benchmark varies.

    Attributes:
        name: of the sheet.
        title: of the sheet.
        label: with its unit.
        values: in their order; a value as people read it, and the arguments of `View.rows` that pick its rows.
    """

    name: str
    title: str
    label: str
    values: tuple[tuple[str, dict[str, object]], ...]

    @property
    def places(self) -> list[float]:
        """Where the values stand: numbers at what they are, names one behind the other."""
        numbers = [picks.get(self.name) for _, picks in self.values]
        return [float(x) if isinstance(x, int | float) else row for row, x in enumerate(numbers)]


def axes_of(outcome: Outcome) -> list[Axis]:
    """Return what a benchmark varies."""
    plan, sweeps = outcome.plan, outcome.plan.sweeps
    still: dict[str, object] = {"channel": IDEAL}
    axes = [
        Axis(
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
        axes.append(Axis(name, title, label, tuple((f"{v:g}", {**still, name: v}) for v in shown)))
    axes.append(Axis("channels", "Channels", "channel", tuple((name, {"channel": name}) for name in plan.channels)))
    return [axis for axis in axes if len(axis.values) > 1]


def sweep_sheet(view: View, axis: Axis) -> Sheet:
    """Return the methods over the values of an axis, in clean frames."""
    columns = [Column(text) for text, _ in axis.values]
    if axis.name == "channels":
        columns += [Column(f"{text}, kB / age ms / heard %", ("kB", "ms", "%"), "", 1.0, 0) for text, _ in axis.values]
    lines, shown = [], []
    for method in view.settings:
        found = [view.rows(method, **picks) for _, picks in axis.values]  # type: ignore[arg-type]
        cells = [view.ap(rows) for rows in found]
        if all(math.isnan(cell[0].mean) for cell in cells[1:]):
            continue
        shown.append(method)
        cells += [_air(rows) for rows in found] if axis.name == "channels" else []
        lines.append(Line(method, tuple(cells), view.mark(method)))
    sent = _bytes(view, shown) if axis.name == "channels" else ""
    note = f"{_AP}, clean frames, over: {axis.label}.{sent}{made_of(view, shown)}"
    title, footnotes = f"{axis.title}, {view.dataset}", view.footnotes(shown)
    return Sheet(axis.name, title, note, "Method", tuple(columns), tuple(lines), footnotes=footnotes)


def _air(rows: Sequence[Row]) -> tuple[Stat, ...]:
    """Return kB sent per frame, age of what is used, ms, and share of the senders heard, %."""
    return tuple(
        Stat.of([math.nan if (value := getattr(row, name)) is None else scale * value for row in rows])
        for name, scale in (("bytes_per_frame", 1e-3), ("message_age_s", 1e3), ("heard", 100.0))
    )


def severity_sheet(view: View, severities: Sequence[int]) -> Sheet:
    """Return the mean AP under the corruptions over their severities."""
    columns = [Column(CLEAN.capitalize()), *(Column(f"severity {level}") for level in severities)]
    lines = []
    for method in compared(view):
        cells = [view.ap(view.rows(method))]
        for level in severities:
            groups = [view.rows(method, kind, severity=level) for kind in view.kinds()]
            trainings = zip(*groups, strict=True)
            means = [
                [sum(row.metrics[name] for row in rows) / len(rows) for name in NAMES] for rows in trainings if rows
            ]
            cells.append(tuple(Stat.of([pair[k] for pair in means]) for k in range(2)))
        lines.append(Line(method, tuple(cells), view.mark(method)))
    note = f"{_AP}, mean of the corruptions.{made_of(view, compared(view))}"
    title, footnotes = f"Severity, {view.titled}", view.footnotes(compared(view))
    return Sheet("severity", title, note, "Method", tuple(columns), tuple(lines), footnotes=footnotes)


def visibility_sheet(view: View) -> Sheet | str:
    """Return the AP of boxes by how much of them the ego sees."""
    if not any(name.endswith("_hidden") for entry in view.entries for name in entry.row.metrics):
        return f"Visibility is left out: nobody has measured it in {view.dataset}."
    columns = [Column(f"{name}, {low:.0%} to {min(high, 1.0):.0%}") for name, (low, high) in VISIBILITY.items()]
    lines = [
        Line(
            method,
            tuple(view.ap(view.rows(method), [f"{name}_{part}" for name in NAMES]) for part in VISIBILITY),
            view.mark(method),
        )
        for method in compared(view)
    ]
    note = (
        f"{_AP}, clean frames, of boxes by the share of the ego's rays on them that nothing else stops."
        f"{made_of(view, compared(view))}"
    )
    title, footnotes = f"By what the ego sees, {view.dataset}", view.footnotes(compared(view))
    return Sheet("visibility", title, note, "Method", tuple(columns), tuple(lines), footnotes=footnotes)


def mean_corrupted(clean: float, by_corruption: dict[str, float]) -> float:
    """Return the mean average precision over the corruptions, clean frames left out."""
    return sum(by_corruption.values()) / len(by_corruption)


def corruption_sheets(view: View, severities: Sequence[int]) -> list[Sheet | str]:
    """Return the tables of one family of corruptions; for one that lacks its methods the line that says so."""
    sheets: list[Sheet | str] = [table_1(view), table_1(view, opencood=True), table_2(view), table_3(view)]
    sheets.append(table_4(view))
    if len(severities) > 1 and view.kinds():
        sheets.append(severity_sheet(view, sorted(severities)))
    return sheets


def clean_sheets(view: View, axes: Sequence[Axis]) -> list[Sheet | str]:
    """Return the tables of clean frames, which are the same for all families."""
    return [visibility_sheet(view), *(sweep_sheet(view, axis) for axis in axes)]


def sheets_of(outcome: Outcome, dataset: str) -> list[Sheet | str]:
    """Return all tables of a dataset, family by family, those of clean frames last."""
    views = [View.of(outcome, dataset, family) for family in outcome.plan.families]
    sheets = [sheet for view in views for sheet in corruption_sheets(view, outcome.plan.severities)]
    return [*sheets, *clean_sheets(views[0], axes_of(outcome))]


def _lacks(table: str, what: str) -> str:
    return f"{table} is left out: it needs {what}."


def made_of(view: View, methods: Sequence[str], *, spread: bool = True) -> str:
    """Return what the numbers of a table come from: frames and boxes, recipe and range, trainings.

    Args:
        view: the rows.
        methods: of the table.
        spread: say what ± is, where a method has several trainings.
    """
    if not methods:
        return ""
    rows = [row for method in methods for row in view.rows(method)[:1]]
    counts = dict.fromkeys(f"{row.frames} frames with {row.truth} boxes" for row in rows)
    several = spread and any(len(view.trained[method]) > 1 for method in methods)
    about = " ± is the standard deviation between trainings." if several else ""
    recipes = _told(methods, {method: _recipe(view.trained[method]) for method in methods})
    seeds = _told(
        methods,
        {method: ", ".join(_or_unknown(one.seed) for one in view.trained[method]) for method in methods},
    )
    return f" {' or '.join(counts)}. Recipe and range: {recipes}. Seeds of the trainings: {seeds}.{about}"


def _recipe(trained: Sequence[Trained]) -> str:
    x0, y0, _, x1, y1, _ = trained[0].settings.grid.range_m
    names = dict.fromkeys(one.recipe or "not known" for one in trained)
    return f"{' or '.join(names)}, x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m"


def _or_unknown(seed: int | None) -> str:
    return "not known" if seed is None else str(seed)


def _told(methods: Sequence[str], texts: dict[str, str]) -> str:
    """Return a text per method, the most frequent one last and for the others."""
    groups: dict[str, list[str]] = {}
    for method in methods:
        groups.setdefault(texts[method], []).append(method)
    *fewer, usual = sorted(groups, key=lambda text: len(groups[text]))
    parts = [f"{text} ({', '.join(groups[text])})" for text in fewer]
    return "; ".join([*parts, f"{usual} (the others)" if fewer else usual])


def _bytes(view: View, methods: Sequence[str]) -> str:
    """Return what is special about the bytes of some methods."""
    special = {
        "where2comm": "is an upper bound: the whole first scale, of which it sends a part",
        "late": "is of the objects of the ground truth that a sender has points on, not of its detections",
    }
    told = [f" That of {name} {special[f]}." for name in methods if (f := view.settings[name].fusion) in special]
    return "".join(told)
