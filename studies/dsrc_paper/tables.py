"""Tables 2 to 4 of the paper, made of the results of a dataset; a text in place of a table without its methods."""

from collections.abc import Sequence

from dsrc.evaluation.metrics.robustness import mce, mean_ap
from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.report.tables import ap_column, ap_table
from dsrc.evaluation.results import CLEAN, condition_title
from dsrc.tables.table import Table, TableRow
from studies.dsrc_paper.methods import PLAIN, WHOLE, plain, variant, whole


def table_2(results: DatasetResults) -> Table | str:
    """Table 2, DSRC and its parts, or a text that names the missing methods."""
    dsrc = whole(results, "attention")
    if dsrc is None:
        return _missing_methods("Table 2", "a method with attention, SDD, PCP and REC (dsrc)")
    like, lines, found, missing = results.settings[dsrc], [], [], []
    for parts in (PLAIN, (True, False, False), (False, True, False), (True, True, False), WHOLE):
        method = variant(results, like, parts)
        label = " + ".join(part for part, there in zip(("SDD", "PCP", "REC"), parts, strict=True) if there) or "none"
        if method is None:
            missing.append(label)
            continue
        found.append(method)
        clean = results.ap(results.rows(method))
        cells = (clean, results.summary(method, mean_corrupted), results.summary(method, mean_ap))
        lines.append(TableRow(label, cells, results.mark(method)))
    if len(lines) < 2:
        return _missing_methods("Table 2", f"'{dsrc}' with other parts: {', '.join(missing)}")
    columns = [ap_column(head) for head in ("Clean", "Mean of the corruptions", "Mean with clean")]
    without = f" Left out, for want of a method: {', '.join(missing)}." if missing else ""
    about = f". {results.level} The paper's numbers agree with its mean with clean, whatever its caption says.{without}"
    title = f"Table 2. Parts of DSRC, {results.titled}"
    return ap_table(results, "table_2", title, columns, lines, about, head="Parts", methods=found)


def table_3(results: DatasetResults) -> Table | str:
    """Table 3, DSRC around fusion by maximum and by attention, or a text that names the missing methods."""
    return _pairs(
        results,
        "Table 3",
        "DSRC around another fusion",
        (("max", "Maximum", "f-cooper, dsrc-max"), ("attention", "Attention", "attfuse, dsrc")),
    )


def table_4(results: DatasetResults) -> Table | str:
    """Table 4, DSRC for a single vehicle, or a text that names the missing methods."""
    return _pairs(
        results, "Table 4", "A single vehicle", (("none", "No collaboration", "no-collaboration, dsrc-alone"),)
    )


def _pairs(results: DatasetResults, title: str, what: str, fusions: Sequence[tuple[str, str, str]]) -> Table | str:
    """Table of conditions over pairs of methods, without and with DSRC."""
    columns, methods, missing = [], [], []
    for fusion, label, wanted in fusions:
        pair = plain(results, fusion), whole(results, fusion)
        if pair[0] is None or pair[1] is None:
            missing.append(wanted)
            continue
        titles = (results.marked(label, pair[0]), results.marked(f"{label} + DSRC", pair[1]))
        columns += [ap_column(text, better="") for text in titles]  # the best of a line matters, not of a column
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
    name = title.lower().replace(" ", "_")
    title = f"{title}. {what}, {results.titled}"
    return ap_table(
        results, name, title, columns, lines, f". {results.level}{without}", head="Condition", methods=methods
    )


def mean_corrupted(clean: float, by_corruption: dict[str, float]) -> float:
    """Mean average precision over the corruptions, without clean frames."""
    return sum(by_corruption.values()) / len(by_corruption)


def _missing_methods(table: str, what: str) -> str:
    return f"{table} is left out: it needs {what}."
