"""Tables 1 to 4 of the paper, made of the results of a dataset."""

from collections.abc import Sequence

from dsrc.evaluation.metrics.ap import metric_name
from dsrc.evaluation.metrics.robustness import mce, mean_ap
from dsrc.evaluation.report.dataset_results import NAMES, PLAIN, WHOLE, DatasetResults, compared_methods
from dsrc.evaluation.report.notes import AP_NOTE, bytes_note, sample_note
from dsrc.evaluation.report.sweep_tables import severity_table
from dsrc.evaluation.results import CLEAN, condition_title
from dsrc.evaluation.table import Column, ResultTable, Stat, TableRow

OPENCOOD_NAMES = (metric_name("bev", 0.5, opencood=True), metric_name("bev", 0.7, opencood=True))


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
        f"{AP_NOTE}; {order}. {results.level} mCE: share of the clean AP lost, less is better; mAP: mean over "
        f"clean and corrupted frames. kB: what all collaborators send for a frame, clean."
        f"{bytes_note(results, compared_methods(results))} ms: median time of a detection."
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
    for parts in (PLAIN, (True, False, False), (False, True, False), (True, True, False), WHOLE):
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
        f"{AP_NOTE}. {results.level} The paper's numbers agree with its mean with clean, whatever its caption "
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
    note = f"{AP_NOTE}. {results.level}{sample_note(results, methods)}{without}"
    name = title.lower().replace(" ", "_")
    title, footnotes = f"{title}. {what}, {results.titled}", results.footnotes(methods)
    return ResultTable(name, title, note, "Condition", tuple(columns), tuple(lines), footnotes=footnotes)


def mean_corrupted(clean: float, by_corruption: dict[str, float]) -> float:
    """Mean average precision over the corruptions, without clean frames."""
    return sum(by_corruption.values()) / len(by_corruption)


def _missing_methods(table: str, what: str) -> str:
    return f"{table} is left out: it needs {what}."
