"""Evaluate checkpoints on a folder of drives: the work behind `dsrc evaluate` and the demo."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
from rich.table import Table

from dsrc.data.executors import Progress
from dsrc.data.provenance import provenance
from dsrc.evaluation.benchmark import PAPER_TABLE, Method, corruption_kinds, run_benchmark
from dsrc.evaluation.config import named
from dsrc.evaluation.files import result_table, rows_to_csv, rows_to_json, timings_to_csv
from dsrc.evaluation.plots import corruption_bars, png_bytes, precision_recall_curves, robustness_scatter
from dsrc.evaluation.results import Row
from sensors.corruptions import Family
from sim.errors import CheckpointError, SettingsError, complaint
from sim.files import file_sha256, write_file
from sim.radio import get_channel

EGO_ALONE = "ego alone"


def evaluate_checkpoints(
    checkpoints: Sequence[Path] | Mapping[str, Path],
    *,
    data: Path,
    out: Path,
    corruptions: Sequence[str] = (PAPER_TABLE,),
    severity: int = 3,
    seed: int = 0,
    limit: int | None = None,
    ego_alone: bool = True,
    progress: Progress | None = None,
    family: Family = "physical",
    channels: Sequence[str] = (),
    engine: str = "fused",
) -> Table:
    """Evaluate detectors and write `results.csv`, `results.json`, `timings.csv` and the plots.

    Args:
        checkpoints: detector files, or names and files; in a sequence `name=path` names one, else the file does.
        data: folder of drives, or one drive.
        out: folder for the results.
        corruptions: kinds, `paper_six`, `all` or `clean`.
        severity: 1 to 5; 3 is the paper's setting.
        seed: of the corruptions.
        limit: evaluate at most this many frames, evenly spread.
        ego_alone: also evaluate the first detector without collaborators.
        progress: called with frames done and frames in all.
        family: of the corruptions' settings.
        channels: presets of the radio channel; every cooperative detector is evaluated through each of them. Without
            any, everything arrives at once and nothing is counted.
        engine: how the networks run, one of `dsrc.models.storage.deploy.ENGINES`.

    Returns:
        The table for the terminal.

    Raises:
        UserError: a file, a corruption or a setting is wrong.
    """
    from dsrc.data.drives import list_drives
    from dsrc.models.storage.checkpoint import load_student

    kinds = corruption_kinds(corruptions, family)
    files = dict(checkpoints) if isinstance(checkpoints, Mapping) else name_checkpoints(checkpoints)
    specs = {name: get_channel(name) for name in channels}
    detectors = {name: load_student(path, engine=engine) for name, path in files.items()}
    methods = [Method(name, detector) for name, detector in detectors.items() if not specs]
    for channel, spec in specs.items():
        methods += [Method(f"{name}, {channel}", detector, channel=spec) for name, detector in detectors.items()]
    if not methods:
        raise SettingsError(complaint("evaluate", "checkpoints", "at least one detector", "none"))
    if ego_alone:
        first = next(iter(detectors))
        methods.append(Method(f"{first}, {EGO_ALONE}", detectors[first], agents=1))
    drives = list_drives(data)
    out.mkdir(parents=True, exist_ok=True)  # a folder that cannot be is told before the work, not after
    rows = run_benchmark(methods, drives, kinds or ("clean",), severity, seed, limit, progress, family)
    settings = {
        "checkpoints": {name: {"file": path.name, "sha256": file_sha256(path)} for name, path in files.items()},
        "conditions": ["clean", *kinds],
        "severity": severity,
        "family": family,
        "limit": limit,
        "ego_alone": ego_alone,
        "engine": engine,
    }
    if specs:
        settings["channels"] = {name: msgspec.to_builtins(spec) for name, spec in specs.items()}
    write_results(out, rows, provenance(settings, seed, drives))
    return result_table(rows)


def name_checkpoints(checkpoints: Sequence[Path]) -> dict[str, Path]:
    """Return checkpoints by name: `name=path` as it says, else the file's stem, its folder's name where stems repeat.

    Raises:
        CheckpointError: two of them have one name.
    """
    found: dict[str, Path] = {}
    for name, path in named([str(path) for path in checkpoints]):
        if name in found:
            raise CheckpointError(f"{path}: a detector of the name '{name}' is there already; give names: name=path")
        found[name] = Path(path)
    return found


def write_results(out: Path, rows: Sequence[Row], made_by: Mapping[str, object]) -> None:
    """Write tables and plots, each file atomically.

    `results.csv`, `results.json` and the plots are the same for the same run; times, which are not, have their own
    file.
    """
    write_file(out / "results.json", rows_to_json(rows, made_by))
    write_file(out / "results.csv", rows_to_csv(rows, made_by))
    write_file(out / "timings.csv", timings_to_csv(rows))
    figures = {
        "ap_per_corruption": corruption_bars(rows),
        "mce_map": robustness_scatter(rows),
        "precision_recall": precision_recall_curves(rows),
    }
    for name, figure in figures.items():
        write_file(out / f"{name}.png", png_bytes(figure, made_by))
