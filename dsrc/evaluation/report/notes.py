"""Notes below the tables of a benchmark: its sample, and bytes that are counted in a way of their own."""

from collections.abc import Sequence

from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.runner import TrainedDetector


def sample_note(results: DatasetResults, methods: Sequence[str], *, spread: bool = True) -> str:
    """Note on a table's sample: frames and boxes, recipe and range, trainings.

    Args:
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


def bytes_note(results: DatasetResults, methods: Sequence[str]) -> str:
    """Note on methods whose bytes are counted in a way of their own."""
    special = {
        "where2comm": "is an upper bound: the whole first scale, of which it sends a part",
        "late": "is of the objects of the ground truth that a sender has points on, not of its detections",
    }
    first = {name: results.trained[name][0] for name in methods}
    counted = {name: one.fusion for name, one in first.items() if "messages" not in one.use}
    notes = [f" That of {name} {special[fusion]}." for name, fusion in counted.items() if fusion in special]
    return "".join(notes)
