"""Readers of what training and evaluation leave: detectors, results and runs."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from msgspec.structs import replace

from dsrc.closed_loop.campaign.run import EPISODES, EpisodeResult, results_csv
from dsrc.evaluation.cache import read_cell
from dsrc.evaluation.cache import read_settings as cell_settings
from dsrc.evaluation.evaluate import evaluate_drives
from dsrc.evaluation.stored import read_index, read_run
from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import join_files, load_detector, load_joined, read_meta, save_detector
from dsrc.models.storage.import_dsrc import import_detector
from dsrc.models.storage.import_opencood import PublishedTraining, import_opencood
from dsrc.options.detection import Evaluation
from dsrc.review.errors.notes import NoteBook
from dsrc.review.sources.results import open_results
from dsrc.training.metrics_file import MetricsFile
from dsrc.training.recipes import debug
from dsrc.training.run_folder import RunFolder
from dsrc.training.train import train
from dsrc.training.verify import verify
from tests.dsrc.evaluation import small
from tests.dsrc.models.storage.opencood_networks import RANGE_M, network
from tests.dsrc.training.drive import write_drive as write_drive_of_cars
from tests.dsrc.training.runs import tiny
from tests.fuzz.target import Target


def learned_targets(folder: Path) -> list[Target]:
    """Write a small file for every reader; return the readers."""
    return [*_detectors(folder), *_results(folder), *_runs(folder)]


def _detectors(folder: Path) -> list[Target]:
    detector, imported = folder / "detector.pt", folder / "net_epoch1.pth"
    made = Detector(replace(debug().model, shrink_norm=False))
    save_detector(detector, made, {"seed": 1})
    torch.save({published_name(name): tensor for name, tensor in made.state_dict().items()}, imported)
    zoo = folder / "net_epoch2.pth"
    torch.save(network("v2vnet", kernel=3), zoo)
    both = folder / "both.pt"
    people = Detector(replace(made.settings, users="vulnerable"))
    save_detector(folder / "people.pt", people, {"seed": 2})
    join_files([detector, folder / "people.pt"], both)
    return [
        Target("detectors, joined", both, load_joined, "tensors"),
        Target("detector", detector, lambda path: (load_detector(path), read_meta(path)), "tensors"),
        Target("published detector", imported, lambda path: import_detector(path, made.settings.grid), "tensors"),
        Target(
            "detector of OpenCOOD",
            zoo,
            lambda path: import_opencood(path, PublishedTraining(range_m=RANGE_M)),
            "tensors",
        ),
    ]


def published_name(name: str) -> str:
    """Return the name of a detector's tensor in the published code."""
    name = name.replace("encoder.", "pillar_vfe.pfn_layers.0.").replace("decoder.", "backbone.deblocks.")
    name = name.replace("shrink.", "shrink_conv.layers.0.double_conv.")
    return re.sub(r"backbone\.stages\.(\d)", lambda found: f"backbone.resnet.layer{int(found[1]) + 1}", name)


def _results(folder: Path) -> list[Target]:
    """Results of an evaluation, which `dsrc view` opens and another evaluation resumes."""
    drives, out = small.write_drives(folder / "judged", drives=1, frames=1), folder / "results"
    checkpoint = small.write_detector(folder / "judge.pt", "dsrc")
    evaluate_drives(Evaluation(checkpoint=(str(checkpoint),), data=drives, out=out, corruption=()))
    cell = sorted((out / "cells").glob("*.npz"))[0]
    notes, episodes = folder / "notes.json", folder / "episodes"
    NoteBook(notes).put("drive_0, 0: missed 3", "behind a bus", ["occlusion"])
    episodes.mkdir()
    (episodes / "a.npz").touch()
    driven = episodes / "a.json"
    words = dict.fromkeys(EpisodeResult.__struct_fields__, "ideal")
    driven.write_text(json.dumps(words | {"severity": 3, "seed": 1, "detectable": True, "metrics": {"risk": 0.5}}))

    def told(_: Path) -> object:
        result = EPISODES.find(episodes, "a")
        return None if result is None else results_csv([result])

    def judged(_: Path) -> object:
        return [read_run(out, keys) for run in read_index(out).runs for keys in run.cells], open_results(out)

    return [
        Target(
            "cell",
            cell,
            lambda path: (read_cell(path.parent, path.stem), cell_settings(path.parent, path.stem)),
            "arrays",
        ),
        Target("times of a cell", cell.with_suffix(".seconds"), lambda path: read_cell(path.parent, path.stem), "text"),
        Target("index of results", out / "detections.json", judged, "text"),
        Target("notes", notes, lambda path: NoteBook(path).tags, "text"),
        Target("result of an episode", driven, told, "text"),
    ]


def _runs(folder: Path) -> list[Target]:
    """A finished training, which `dsrc model verify` reads and the same command resumes."""
    run = RunFolder(folder / "run" / "plain")
    train(tiny(epochs=1), write_drive_of_cars(folder / "cars", 2), run.path, "plain")
    record = json.loads(run.settings.read_text())
    rows = MetricsFile(run.path)
    trainer: Any = SimpleNamespace(current_epoch=3)
    return [
        Target("settings of a run", run.settings, lambda _: (run.state(record), verify(run.path)), "text"),
        Target("result of a run", run.result, lambda _: verify(run.path), "text"),
        Target("environment of a run", run.environment, lambda _: run.note_environment(1), "text"),
        Target("metrics of a run", rows.path, lambda _: rows.on_train_start(trainer, trainer), "text"),
    ]
