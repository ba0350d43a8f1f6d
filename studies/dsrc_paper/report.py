"""Sections with the tables and figures of the DSRC paper, from the results of a benchmark."""

from dataclasses import replace
from pathlib import Path

from matplotlib.figure import Figure

from dsrc.evaluation.figures.bars import corruption_bars, table_heatmap
from dsrc.evaluation.figures.points import robustness_scatter
from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.report.report import mean_rows, provenance_of
from dsrc.evaluation.report.tables import table_1
from dsrc.evaluation.runner import BenchmarkResult
from dsrc.tables.document import Section, SectionWriter, slug
from dsrc.tables.table import Table
from studies.dsrc_paper.figures import mean_bars, table_dots
from studies.dsrc_paper.methods import averaged_methods, compared_methods, method_styles, plain, trained_methods, whole
from studies.dsrc_paper.pictures import write_pictures
from studies.dsrc_paper.published import published_tables
from studies.dsrc_paper.tables import table_2, table_3, table_4


def write_paper(result: BenchmarkResult, out: Path) -> list[Section]:
    """Write Tables 1 to 4 and Figures 4 to 6 and 8; return their sections.

    They take the places of the benchmark's own sections of these names. The numbers that the paper prints stand below
    those of the first family of corruptions.
    """
    sections = []
    for dataset in result.drives:
        writer = SectionWriter(out / slug(dataset), provenance_of(result))
        for family in result.plan.family:
            suffix = "" if family == result.plan.family[0] else f"_{family}"
            _write_tables(DatasetResults.of(result, dataset, family), writer, suffix)
        if dataset == result.plan.datasets[0].name:
            write_pictures(result, writer)
        sections += [section.below(slug(dataset)) for section in writer.sections]
    return sections


def _write_tables(results: DatasetResults, writer: SectionWriter, suffix: str) -> None:
    published = {} if suffix else published_tables()
    compared = {name: results.trained[name] for name in compared_methods(results)}
    narrow = replace(results, trained=compared)
    for opencood in (False, True):
        sheet = table_1(narrow, opencood=opencood)
        sheet = replace(sheet, title=f"Table 1. {sheet.title}")
        figure = table_heatmap(sheet) if sheet.rows and not opencood else None
        writer.table(sheet, figure, suffix, _below(published, sheet))
    for table in (table_2(results), table_3(results), table_4(results)):
        if isinstance(table, str):
            writer.section(f"{table.split(' is ')[0].lower().replace(' ', '_')}{suffix}", f"{table}\n")
        else:
            writer.table(table, _figure_of(table, results), suffix, _below(published, table))
    if results.kinds():
        four = f"Figure 4. Mean of all methods under each corruption, {results.titled}"
        five = f"Figure 5. mCE against mean AP, {results.titled}"
        means, rows = mean_rows(results, averaged_methods(results)), mean_rows(results, trained_methods(results))
        writer.figure(f"figure_4{suffix}", mean_bars(means, title=four), four)
        writer.figure(f"figure_5{suffix}", robustness_scatter(rows, method_styles(results), five), five)


def _below(published: dict[str, Table], table: Table) -> str:
    return f"\n{published[table.name].markdown()}" if table.name in published else ""


def _figure_of(table: Table, results: DatasetResults) -> Figure:
    if table.name == "table_2":
        return table_dots(table)
    fusions = ("max", "attention") if table.name == "table_3" else ("none",)
    pairs = [(plain(results, fusion), whole(results, fusion)) for fusion in fusions]
    methods = [name for pair in pairs if None not in pair for name in pair if name]
    return corruption_bars(mean_rows(results, methods), styles=method_styles(results), title=table.title)
