"""Methods of the paper's tables, found by their fusion and the parts of DSRC (SDD, PCP, REC) that trained them."""

from msgspec.structs import replace

from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.models.settings import ModelSettings
from dsrc.tables.figure import Style, styles_of

PLAIN, WHOLE = (False, False, False), (True, True, True)
_STYLED = (
    "attention", "none", "late", "max", "v2vnet", "v2xvit", "cobevt", "where2comm", "coalign", "ermvp", "mrcnet",
    "early", "max_map",
)  # fmt: skip
"""Fusions in the order of their styles, those of the paper first: there are fewer colours than fusions."""


def parts_of(settings: ModelSettings) -> tuple[bool, bool, bool]:
    """Parts (SDD, PCP, REC) that trained a detector."""
    return settings.sdd, settings.pcp, settings.rec


def variant(results: DatasetResults, like: ModelSettings, parts: tuple[bool, bool, bool]) -> str | None:
    """First method that differs from `like` in (SDD, PCP, REC) alone."""
    sdd, pcp, rec = parts
    wanted = replace(like, sdd=sdd, pcp=pcp, rec=rec)
    return next((name for name, settings in results.settings.items() if settings == wanted), None)


def whole(results: DatasetResults, fusion: str) -> str | None:
    """First method of a fusion with all parts of DSRC."""
    return _first(results, fusion, WHOLE)


def plain(results: DatasetResults, fusion: str) -> str | None:
    """First method of a fusion without parts of DSRC; preferably one that equals `whole` otherwise."""
    other = whole(results, fusion)
    alike = None if other is None else variant(results, results.settings[other], PLAIN)
    return alike or _first(results, fusion, PLAIN)


def _first(results: DatasetResults, fusion: str, parts: tuple[bool, bool, bool]) -> str | None:
    return next((n for n, s in results.settings.items() if s.fusion == fusion and parts_of(s) == parts), None)


def compared_methods(results: DatasetResults) -> list[str]:
    """Methods of Table 1: all but DSRC with only some of its parts, which Table 2 has."""
    return [name for name, settings in results.settings.items() if parts_of(settings) in (PLAIN, WHOLE)]


def trained_methods(results: DatasetResults) -> list[str]:
    """Methods of Table 1 without variants in use, which have another's weights and almost its place in a figure."""
    return [name for name in compared_methods(results) if not results.trained[name][0].use]


def method_styles(results: DatasetResults) -> dict[str, Style]:
    """Styles of all methods: DSRC and every plain fusion have the same in all benchmarks, whatever else is there."""
    of_fusions = [plain(results, fusion) or fusion for fusion in _STYLED]
    return styles_of([whole(results, "attention") or "DSRC", *of_fusions, *results.trained])


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
