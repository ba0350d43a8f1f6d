"""Report of a search: tables of optimisers and failures, the plot of the best so far, and their files."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from dsrc.closed_loop.campaign.run import results_csv
from dsrc.closed_loop.falsification.run import Failure, Falsification, Trial
from dsrc.options.search import SearchOptions
from dsrc.runs.provenance import provenance
from dsrc.tables.files import Scalar, csv_text
from dsrc.tables.table import Column, Table, TableRow
from sim.files import write_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NO_FAULT = "none"


def optimizer_table(found: Falsification) -> Table:
    """Table of the optimisers at equal budget."""
    columns = [Column(title) for title in ("episodes", "first failure", "crashes", "distinct", "smallest")]
    rows = []
    for name, trials in found.trials.items():
        first = next((str(one.number) for one in trials if one.crashed), "-")
        crashes = [one.size for one in trials if one.crashed]
        least = f"{min(crashes):.2f}" if crashes else "-"
        cells = str(len(trials)), first, str(len(crashes)), str(len(found.found_by(name))), least
        rows.append(TableRow(name, cells))
    judged = ""
    if found.judged:
        crashes = [one.size for one in found.judged if one.crashed]
        judged = f" Searched with {found.options.fast}; {found.options.perception} judged {len(found.judged)} of these"
        judged += f" episodes, of which {len(crashes)} crashed; distinct are failures of the judge."
    caption = (
        "First failure: number of the first episode that crashed. Smallest: the smallest fault that crashed, as a "
        f"share of its ranges.{judged}"
    )
    return Table("optimizers", "", "optimizer", tuple(columns), tuple(rows), caption=caption)


def failure_table(found: Falsification) -> Table:
    """Table of the distinct failures, the smallest fault first."""
    columns = [Column(title, align="left") for title in ("scenario", "cause", "smallest fault")]
    columns += [Column(title) for title in ("seed", "crashes", "nearby")]
    columns += [
        Column("parameters", align="left", terminal=any(one.first.candidate.parameters for one in found.failures))
    ]
    columns += [Column("log", align="left", terminal=False)]
    rows = []
    for number, one in enumerate(found.failures, start=1):
        own, near = one.first.candidate, f"{one.still} of {one.near}" if one.near else "-"
        cells = own.scenario, one.cause, candidate_fault(one), str(own.seed), str(len(one.trials)), near
        rows.append(TableRow(str(number), (*cells, _parameters(one.first), log_of(one))))
    caption = (
        "Distinct: of one scenario and cause, the ego within 5 m. Crashes: episodes of the search. Nearby: of the "
        "episodes with one number of the smallest fault a tenth larger or smaller, those that still crash."
    )
    return Table("failures", "", "failure", tuple(columns), tuple(rows), caption=caption if rows else "")


def candidate_fault(one: Failure) -> str:
    """Return the smallest fault of a failure that is known, `none` where it crashes without any."""
    return (one.first.candidate.fault if one.fault is None else one.fault) or NO_FAULT


def log_of(one: Failure) -> str:
    """Return the path of the log of a failure in the folder of the search."""
    return f"episodes/{one.key or one.first.key}.npz"


def _parameters(one: Trial) -> str:
    return ", ".join(f"{name}={value:g}" for name, value in one.candidate.parameters)


def best_figure(found: Falsification) -> "Figure":
    """Draw the best value so far over the episodes of each optimiser."""
    from dsrc.tables.figure import WIDTH_IN, figure_style, panels, styles_of

    styles = styles_of(list(found.trials))
    with figure_style():
        title = f"Search for a crash: {', '.join(found.options.scenario)}"
        figure, (axes,) = panels(WIDTH_IN, 3.4, title=title)
        for name, trials in found.trials.items():
            best = list(itertools.accumulate((one.value for one in trials), min))
            line = {**styles[name].line(), "marker": ""}
            axes.step(range(1, len(best) + 1), best, where="post", label=name, **line)
        axes.axhline(0.0, color="0.5", linewidth=0.8, linestyle=":")
        axes.set(xlabel="episodes", ylabel="best so far", ylim=(-1.05, 1.05))
        axes.annotate("crash below 0: size of its fault less 1", (0.01, 0.02), xycoords="axes fraction", fontsize=8)
        axes.annotate("no crash: least time to collision / 10 s", (0.01, 0.94), xycoords="axes fraction", fontsize=8)
        axes.legend(loc="upper right")
    return figure


def write_search(found: Falsification, out: Path) -> list[Path]:
    """Write results.csv, tried.csv, failures.csv, optimizers.csv, search.png, report.md and plan.json; return paths."""
    from dsrc.tables.figure import write_figure

    made_by = provenance(_settings(found), seed=found.options.search_seed)
    write_file(out / "plan.json", msgspec.json.format(msgspec.json.encode(found.plan)))
    write_file(out / "results.csv", results_csv(found.results))
    every = [one for own in (*found.trials.values(), found.judged) for one in own]
    write_file(out / "tried.csv", csv_text([_tried(one) for one in every], made_by=made_by))
    write_file(out / "failures.csv", csv_text(_records(found.failures), _FAILURE_COLUMNS, made_by))
    tables = optimizer_table(found), failure_table(found)
    write_file(out / "optimizers.csv", tables[0].csv())
    write_figure(out / "search.png", best_figure(found), made_by)
    write_file(out / "report.md", _markdown(found, tables))
    return [out / name for name in ("report.md", "failures.csv", "tried.csv", "search.png")]


def _settings(found: Falsification) -> dict[str, Any]:
    given = {name: getattr(found.options, name) for name in SearchOptions.__struct_fields__}
    return dict(msgspec.to_builtins(given, builtin_types=(), enc_hook=str))


def _tried(one: Trial) -> dict[str, Scalar]:
    own = one.candidate
    return {
        "optimizer": one.optimizer,
        "number": one.number,
        "scenario": own.scenario,
        "seed": own.seed,
        "fault": own.fault,
        "parameters": _parameters(one),
        "size": one.size,
        "outcome": one.outcome,
        "value": one.value,
        "key": one.key,
    }


_FAILURE_COLUMNS = (
    *("failure", "scenario", "seed", "parameters", "cause", "sentence", "x_m", "y_m", "crashes", "found_by"),
    *("first_fault", "smallest_fault", "near", "still_crash", "log"),
)


def _records(failures: Sequence[Failure]) -> list[dict[str, Scalar]]:
    return [
        {
            "failure": number,
            "scenario": one.first.candidate.scenario,
            "seed": one.first.candidate.seed,
            "parameters": _parameters(one.first),
            "cause": one.cause,
            "sentence": one.sentence,
            "x_m": one.place[0],
            "y_m": one.place[1],
            "crashes": len(one.trials),
            "found_by": " ".join(sorted({trial.optimizer for trial in one.trials})),
            "first_fault": one.first.candidate.fault or NO_FAULT,
            "smallest_fault": None if one.fault is None else one.fault or NO_FAULT,
            "near": one.near,
            "still_crash": one.still,
            "log": log_of(one),
        }
        for number, one in enumerate(failures, start=1)
    ]


def _markdown(found: Falsification, tables: Sequence[Table]) -> str:
    options = found.options
    searched = [*options.fault, *(f"parameter {one}" for one in options.parameter)]
    lines = [f"# Search: {', '.join(options.scenario)}", "", "Driven by `dsrc search`.", ""]
    lines += [f"* `{text}`" for text in searched]
    lines += ["", *(table.markdown() for table in tables), "![Best so far](search.png)", ""]
    for number, one in enumerate(found.failures, start=1):
        lines += [f"* {number}: {one.sentence} (`dsrc view {log_of(one)}`)"]
    return "\n".join(lines) + "\n"
