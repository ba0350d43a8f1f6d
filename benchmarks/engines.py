"""How long the shipped detector takes by every engine, and by runtimes that are not ours where they are installed.

Five agents with a cloud each; turns of all engines, the best of each counts. ONNX Runtime and OpenVINO run the network
that `dsrc model export` writes. `benchmarks.inference` shows the table.
"""

import importlib.util
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from dsrc.closed_loop.perception.open import SHIPPED_DETECTOR
from dsrc.models.detector import Detector
from dsrc.models.fusion import AgentLayout
from dsrc.models.layers.encoder import Pillars
from dsrc.models.storage.checkpoint import load_detector
from dsrc.models.storage.deploy import ENGINES
from dsrc.models.storage.export import export_onnx
from sim.errors import SettingsError

TURNS = 3
_SECONDS_TO_COMPILE = "it compiles for a minute: left out by --quick"
Run = Callable[[], NDArray[np.float32]]
"""One pass; returns the (2, h, w) logits."""


@dataclass(frozen=True, slots=True)
class EngineTime:
    """Time of an engine.

    Attributes:
        cpu_ms: CPU time of a pass, ms; None where it did not run.
        score_error: largest difference of a score from the plain network's; None likewise.
        why: why it did not run.
    """

    cpu_ms: float | None = None
    score_error: float | None = None
    why: str = ""


def engine_times(pillars: Pillars, quick: bool) -> dict[str, EngineTime]:
    """Return the times of all engines by name.

    Args:
        pillars: clouds of one sample's agents, in the shipped detector's grid.
        quick: leave out what takes a minute to start.
    """
    detector = load_detector(SHIPPED_DETECTOR)
    runs: dict[str, Run] = {}
    found: dict[str, EngineTime] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in (*ENGINES, "onnxruntime", "openvino"):
            try:
                runs[name] = _run_of(name, detector, pillars, Path(folder), quick)
                runs[name]()  # compiles, and makes the engines of its layers
            except SettingsError as error:
                found[name] = EngineTime(why=str(error))
        best = dict.fromkeys(runs, float("inf"))
        for _ in range(TURNS):
            for name, run in runs.items():
                start = time.process_time()
                run()
                best[name] = min(best[name], time.process_time() - start)
        exact = _score(runs["plain"]())
        for name, run in runs.items():
            error = float(np.abs(_score(run()) - exact).max())
            found[name] = EngineTime(round(1000 * best[name], 1), round(error, 6))
    return {name: found[name] for name in (*ENGINES, "onnxruntime", "openvino")}


def _score(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    return 1.0 / (1.0 + np.exp(-logits))


def _run_of(name: str, detector: Detector, pillars: Pillars, folder: Path, quick: bool) -> Run:
    """Return a pass by an engine.

    Raises:
        SettingsError: it is not installed, or not for this processor.
    """
    if name in ENGINES:
        if name == "compiled" and quick:
            raise SettingsError(_SECONDS_TO_COMPILE)
        network, layout = ENGINES[name](detector), AgentLayout((pillars.clouds,))

        def run() -> NDArray[np.float32]:
            with torch.inference_mode():
                return network(pillars, layout).cls[0].numpy()

        return run
    if importlib.util.find_spec(name) is None:
        raise SettingsError("not installed")
    path = folder / "detector.onnx"
    if not path.exists():
        export_onnx(detector, path)
    arrays = [tensor.numpy() for tensor in (pillars.points, pillars.pillar, pillars.coords, pillars.count)]
    return _foreign(name, path, [*arrays, np.zeros(pillars.clouds, bool)])


def _foreign(name: str, path: Path, arrays: Sequence[NDArray]) -> Run:
    threads = torch.get_num_threads()
    if name == "onnxruntime":
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        inputs = dict(zip((one.name for one in session.get_inputs()), arrays, strict=True))
        return lambda: session.run(["cls"], inputs)[0][0]
    import openvino

    config = {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": "f32"}
    compiled = openvino.Core().compile_model(str(path), "CPU", config)
    named = dict(zip((one.any_name for one in compiled.inputs), arrays, strict=True))
    return lambda: compiled(named)["cls"][0]
