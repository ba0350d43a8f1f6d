"""Average precision of the shipped detectors in bfloat16 beside float32: the gate of `--engine auto`.

A detector passes where bfloat16 changes AP@0.5 and AP@0.7 by at most 0.3 points in the mean of clean frames and the six
corruptions, and by 1.5 points in each. One that fails joins `FLOAT32_ONLY` of `dsrc/models/storage/deploy.py`.

Where the processor has no bfloat16 its arithmetic is emulated: inputs, weights, biases and outputs of every
convolution rounded to bfloat16, products summed in float32, as oneDNN does with AMX and AVX512-BF16; everything
between the convolutions is PyTorch's own bfloat16 either way. An interrupted run resumes.

    dsrc dataset build dsrc-sim --splits test --out data/dsrc-sim
    python -m studies.bf16_gate --data data/dsrc-sim/test --out runs/bf16-gate --docs docs/models.md
"""

import argparse
import platform
from collections.abc import Iterable
from pathlib import Path

import msgspec
import torch
from torch import Tensor, nn

from dsrc.cli.progress import progress
from dsrc.detectors.texts import SHIPPED_DETECTOR
from dsrc.evaluation.config import Benchmark, DatasetSpec, MethodSpec
from dsrc.evaluation.runner import run_plan
from dsrc.models.detector import Detector
from dsrc.models.device import BFLOAT16
from dsrc.models.layers.encoder import PillarMap
from dsrc.models.storage.checkpoint import load_joined, save_detector
from dsrc.models.storage.deploy import ENGINES, FusedConv, deployed
from sim.files import file_sha256, write_file
from studies.look import put_table

MEAN_POINTS, EACH_POINTS = 0.3, 1.5
METRICS = {"AP@0.5": "ap_bev_50", "AP@0.7": "ap_bev_70"}
FRAMES = 92
"""Of the published tables: four of each drive of the test split."""


class _EmulatedConv(FusedConv):
    """Fused convolution with the numbers of oneDNN's in bfloat16, computed in float32."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast("cpu", enabled=False):
            return super().forward(_rounded(x)).bfloat16()

    def of_pillars(self, x: PillarMap) -> Tensor:
        with torch.autocast("cpu", enabled=False):
            found = PillarMap(_rounded(x.features), x.coords, x.clouds, x.height, x.width)
            return super().of_pillars(found).bfloat16()

    def add_to(self, out: Tensor, x: Tensor) -> Tensor:
        with torch.autocast("cpu", enabled=False):
            return super().add_to(out.float(), _rounded(x)).bfloat16()


class _EmulatedHead(nn.Conv2d):
    """Convolution of a head, likewise."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast("cpu", enabled=False):
            return super().forward(_rounded(x)).bfloat16()


def _rounded(x: Tensor) -> Tensor:
    return x.bfloat16().float()


def emulated(detector: Detector) -> Detector:
    """Copy a detector for inference with the arithmetic of engine `bf16`, on any processor."""
    found = deployed(detector)
    found.precision = torch.bfloat16
    for layer in found.modules():
        if isinstance(layer, FusedConv):
            layer.to(torch.bfloat16).float().__class__ = _EmulatedConv
        elif isinstance(layer, nn.Conv2d):
            layer.to(torch.bfloat16).float().__class__ = _EmulatedHead
    return found


class Gate(msgspec.Struct, frozen=True, kw_only=True):
    """Average precisions of a detector under one condition, by engine, %.

    Attributes:
        detector: name of its file.
        sha256: of its file.
        condition: `clean` or a corruption.
        float32: by metric.
        bfloat16: likewise.
    """

    detector: str
    sha256: str
    condition: str
    float32: dict[str, float]
    bfloat16: dict[str, float]


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """Result of the gate.

    Attributes:
        arithmetic: `bfloat16`, or `emulated`.
        processor: name of the processor.
        frames: number of frames under each condition.
        drives: drives that they are of.
        failed: detectors that fail.
        rows: a detector under a condition each.
    """

    arithmetic: str
    processor: str
    frames: int
    drives: tuple[str, ...]
    failed: tuple[str, ...]
    rows: tuple[Gate, ...]


def shipped(folder: Path) -> dict[str, tuple[Path, str]]:
    """Return file and SHA-256 of the shipped detectors by name; the parts of joined ones are written to a folder."""
    found = {}
    for path in sorted(SHIPPED_DETECTOR.parent.glob("*.pt")):
        detector = load_joined(path, engine="plain")
        if isinstance(detector, Detector):
            found[path.stem] = path, file_sha256(path)
        else:  # the first part is a detector of its own
            part = folder / f"{path.stem}.pt"
            save_detector(part, detector.detectors[1])
            found[path.stem] = part, file_sha256(path)
    return found


def measure(data: Path, out: Path, frames: int, engine: str, detectors: dict[str, tuple[Path, str]]) -> dict:
    """Return rows by method and condition."""
    plan = Benchmark(
        name="bf16-gate",
        methods=tuple(MethodSpec(name=name, detectors=(str(path),)) for name, (path, _) in detectors.items()),
        datasets=(DatasetSpec(name="test", drives=(str(data),)),),
        frames=frames,
    )
    with progress(f"{engine} on {data}") as report:
        result = run_plan(plan, out / engine, engine=engine, progress=report)
    return {(one.case.method, one.case.condition.kind): one.row for one in result.entries}


def changes(rows: Iterable[Gate], metric: str) -> list[float]:
    """Return the points that bfloat16 adds under each condition."""
    return [row.bfloat16[metric] - row.float32[metric] for row in rows]


def passes(rows: Iterable[Gate]) -> bool:
    """Whether a detector passes the gate."""
    listed = list(rows)
    return all(
        max(map(abs, found)) <= EACH_POINTS and abs(sum(found)) / len(found) <= MEAN_POINTS
        for found in (changes(listed, metric) for metric in METRICS)
    )


def gate_rows(result: Result) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return head and lines of the gate's table: a detector and metric each, AP in float32 and its change, %."""
    conditions = list(dict.fromkeys(row.condition for row in result.rows))
    lines = []
    for name in dict.fromkeys(row.detector for row in result.rows):
        own = [row for row in result.rows if row.detector == name]
        for metric in METRICS:
            added = changes(own, metric)
            cells = [f"{row.float32[metric]:.1f} ({points:+.2f})" for row, points in zip(own, added, strict=True)]
            verdict = "fails" if name in result.failed else "passes"
            lines.append((name, metric, *cells, f"{sum(added) / len(added):+.2f}", verdict))
    return ("detector", "", *(name.replace("_", " ") for name in conditions), "mean change", "gate"), lines


def _processor() -> str:
    """Return the name of the processor."""
    listed = Path("/proc/cpuinfo")
    lines = listed.read_text().splitlines() if listed.is_file() else []
    named = (line.partition(": ")[2] for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the test drives")
    parser.add_argument("--out", type=Path, required=True, help="folder of cells and result.json")
    parser.add_argument("--frames", type=int, default=FRAMES, help="frames, evenly spread over all drives")
    parser.add_argument("--docs", type=Path, help="Markdown page that gets the table")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    if not BFLOAT16:
        ENGINES["bf16"] = emulated
    detectors = shipped(options.out)
    by_engine = {
        name: measure(options.data, options.out, options.frames, name, detectors) for name in ("fused", "bf16")
    }
    rows = []
    for key, row in by_engine["fused"].items():
        name, condition = key
        half = by_engine["bf16"][key]
        rows.append(
            Gate(
                detector=name,
                sha256=detectors[name][1],
                condition=condition,
                float32={metric: 100 * row.metrics[field] for metric, field in METRICS.items()},
                bfloat16={metric: 100 * half.metrics[field] for metric, field in METRICS.items()},
            )
        )
    result = Result(
        arithmetic="bfloat16" if BFLOAT16 else "emulated",
        processor=_processor(),
        frames=next(iter(by_engine["fused"].values())).frames,
        drives=tuple(sorted(path.name for path in options.data.iterdir() if path.is_dir())),
        failed=tuple(name for name in detectors if not passes(row for row in rows if row.detector == name)),
        rows=tuple(rows),
    )
    write_file(options.out / "result.json", msgspec.json.format(msgspec.json.encode(result)) + b"\n")
    put_table(options.docs, "bf16_gate", *gate_rows(result))


if __name__ == "__main__":
    main()
