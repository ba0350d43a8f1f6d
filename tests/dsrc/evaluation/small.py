"""Small benchmark: drives, detectors with fitted heads alone, and a plan, all within seconds."""

from functools import lru_cache
from pathlib import Path

import torch
from msgspec.structs import replace

from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.sample import make_sample
from dsrc.evaluation.config import Benchmark, DatasetSpec, MethodSpec
from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import collate
from dsrc.models.storage.checkpoint import save_detector
from dsrc.training.recipes import debug, of_method
from tests.dsrc.training.drive import frame

POINTS = {"ground": 300, "per_car": 60}


def write_drives(root: Path, drives: int = 2, frames: int = 2) -> Path:
    for drive in range(drives):
        for index in range(frames):
            write_frame(root / f"drive_{drive}", frame(index + 10 * drive, **POINTS))
    return root


@lru_cache
def make_detector(method: str, seed: int = 0) -> Detector:
    """Return a detector of random features, whose heads least squares fit to two frames: it finds some boxes."""
    model = of_method(debug(), method).model
    model = replace(model, stage_channels=(8, 8, 8), score_threshold=0.3)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        detector = Detector(model).eval()
        plain = replace(model, sdd=False, pcp=False, rec=False)
        batch = collate([make_sample(frame(i, **POINTS), None, model.grid) for i in (0, 10)], plain, training=True)
        features = detector(batch.student, batch.layout).fused.permute(0, 2, 3, 1).flatten(0, 2).double()
        positive = batch.targets.positive.flatten(0, 2)
        x = torch.cat([features, torch.ones(len(features), 1)], dim=1)
        _fit(detector.cls_head, x, positive.double() * 2 - 1, torch.where(positive.any(1), 30.0, 1.0))
        _fit(detector.reg_head, x, batch.targets.regression.flatten(0, 2).double(), positive.any(1).double())
    return detector


def _fit(head: torch.nn.Conv2d, x: torch.Tensor, wanted: torch.Tensor, weight: torch.Tensor) -> None:
    """Set a head's weights to those of ridge regression."""
    weighted = x * weight[:, None]
    solved = torch.linalg.solve(weighted.T @ x + 1e-9 * torch.eye(x.shape[1]), weighted.T @ wanted)
    head.weight.copy_(solved[:-1].T[:, :, None, None])
    head.bias.copy_(solved[-1])


def write_detector(path: Path, method: str, seed: int = 0) -> Path:
    save_detector(path, make_detector(method, seed), {"seed": seed}, half=False)
    return path


def make_plan(root: Path, methods: dict[str, list[tuple[str, int]]], **settings: object) -> Benchmark:
    """Return a plan of methods, each with detectors (method, seed of the weights), on the drives of a folder."""
    specs = []
    for name, detectors in methods.items():
        files = [write_detector(root / f"{method}_{seed}.pt", method, seed) for method, seed in detectors]
        specs.append(MethodSpec(name=name, detectors=tuple(map(str, files))))
    dataset = DatasetSpec(name="made up", drives=(str(root / "test"),))
    return Benchmark(methods=tuple(specs), datasets=(dataset,), **settings)
