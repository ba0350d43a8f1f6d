"""Detections in drives, `dsrc detect`: an evaluation of clean frames whose boxes are written for others to read."""

from collections.abc import Iterator
from pathlib import Path

from dsrc.detectors.levelled import height_in_use
from dsrc.detectors.texts import kind_of, named
from dsrc.evaluation.cache import read_cell
from dsrc.evaluation.config import Benchmark, DatasetSpec, MethodSpec, check
from dsrc.evaluation.report.report import provenance_of, stored_index, write_results
from dsrc.evaluation.results import CLEAN, Row
from dsrc.evaluation.runner import BenchmarkResult, run_plan
from dsrc.evaluation.scoring.write import FoundFrame, write_json, write_kitti, write_opencood
from dsrc.evaluation.stored import write_index
from dsrc.models.storage.deploy import engine_for
from dsrc.options.detection import Detection
from dsrc.options.fields import takes_fields
from dsrc.runs.executors import SERIAL, Pool, Progress
from sim.radio import IDEAL


@takes_fields(Detection)
def detect_drives(config: Detection, pool: Pool = SERIAL, progress: Progress | None = None) -> tuple[Row, list[Path]]:
    """Detect in the frames of drives, write the boxes and store them for `dsrc view` and `score`; resume what is there.

    Boxes out of the region that the labels of a frame cover are left out, as in `score`; without labels all are kept.

    Args:
        config: see `Detection`.
        pool: workers, of one thread each.
        progress: called with frames done and frames missing at the start.

    Returns:
        The row of all frames, whose average precisions are NaN without ground truth, and the files of boxes.

    Raises:
        UserError: a file, a drive or a setting is wrong.
    """
    (name, text), *_ = named([str(config.checkpoint)])
    use = height_in_use("detect", config.height)
    plan = Benchmark(
        name="detect",
        methods=(MethodSpec(name=name, detectors=(text,), use=use, agents=1 if config.ego_only else None),),
        datasets=(DatasetSpec(name=config.data.name or "data", drives=(str(config.data),)),),
        corruption=(CLEAN,),
        channel=(IDEAL,),
        frames=config.frames,
    )
    check(plan, "detect")
    engine = engine_for(text, config.engine, config.device) if kind_of(text) == "file" else "fused"
    result = run_plan(plan, config.out, pool, config.device, progress, engine, judged=False)
    entries = [(entry, result.trained[name][0]) for entry in result.entries]
    write_results(config.out, provenance_of(result), entries)
    write_index(config.out, stored_index(result, entries))
    frames = list(_frames(result, config.out / "cells"))
    places = [write_json(config.out, frames)]
    if "kitti" in config.format:
        trees = {path.name: path for entry in result.entries for path in entry.drives}
        places.append(write_kitti(config.out, frames, trees))
    if "opencood" in config.format:
        places.append(write_opencood(config.out, frames))
    return result.entries[0].row, places


def _frames(result: BenchmarkResult, folder: Path) -> Iterator[FoundFrame]:
    """Yield the detections of all frames, drive by drive."""
    (entry,) = result.entries
    for key, drive in zip(entry.cells, entry.drives, strict=True):
        table = read_cell(folder, key).table
        for row, one in enumerate(table.results()):
            yield FoundFrame(drive.name, int(table.index[row]), int(table.ego_id[row]), one.detections, one.truth)
