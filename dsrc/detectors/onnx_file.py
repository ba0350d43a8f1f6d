"""Detector of an ONNX file, run by ONNX Runtime: our own export, or another's of points to boxes.

The file of `dsrc model export` holds its settings. Another's has one input `points` (P, 4) float32 x, y, z, m, and
intensity in [0, 1] of all agents' clouds in the ego LiDAR's frame, outputs `boxes` (N, 7) x, y, z, l, w, h, m, and yaw,
rad, and `score` (N,), after thresholds and suppression; metadata `range_m` is a JSON list of the minima and maxima of
x, y and z, `max_agents` a number, 1 without it.
"""

from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from dsrc.data.sample import Sample, SampleRequest
from dsrc.detectors.answers import of_arrays
from dsrc.models.detector import anchors_of, classes_of, decode_maps
from dsrc.models.fusion.late import join_detections
from dsrc.models.inputs.batch import collate
from dsrc.models.inputs.trained_frame import as_sensed, prepared
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.export import INPUTS
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sim.boxes import VEHICLES
from sim.errors import CheckpointError, DataError, SettingsError, complaint, unreadable

_RUNTIME = "onnxruntime"  # not in the keys of results that need none
_Coordinate = Annotated[float, Meta(ge=-1e4, le=1e4)]
_Range = tuple[_Coordinate, _Coordinate, _Coordinate, _Coordinate, _Coordinate, _Coordinate]


class OnnxDetector:
    """Detector of a file that `dsrc model export` wrote; see `dsrc.data.sample.SampleDetector`.

    Attributes:
        settings: of the network, for no more agents than the file takes.
        classes: of what it detects.
    """

    def __init__(self, path: Path, session: Any, metadata: dict[str, str]) -> None:
        self.path, self._session = path, session
        try:
            settings = msgspec.json.decode(metadata["settings"], type=ModelSettings)
        except Exception as error:  # of the parts, which check their own settings
            raise CheckpointError(complaint(path, "settings", "those of a detector", str(error))) from None
        if settings.align_poses:
            raise CheckpointError(complaint(path, "settings.align_poses", "false in ONNX", "true"))
        self._agents = int(count) if (count := metadata.get("agents", "")).isdecimal() else None
        most = min(settings.max_agents, self._agents or settings.max_agents)
        self.settings = msgspec.structs.replace(settings, max_agents=most)
        self.classes = classes_of(settings)
        self._anchors = anchors_of(settings)
        self._inputs = {one.name for one in session.get_inputs()}

    def detect(self, sample: Sample) -> Detections:
        """Detect in one sample, best first.

        Raises:
            DataError: the file takes another number of agents, or tiles of a map were lost, which it cannot leave out.
        """
        if self._agents not in (None, len(sample.clouds)):
            found = f"{len(sample.clouds)} in {sample.key}"
            raise DataError(complaint(self.path, "agents", f"{self._agents}, as it was exported for", found))
        if any(part.any() for part in sample.lost):
            raise DataError(complaint(self.path, "channel", "one without lost packets in ONNX", f"some: {sample.key}"))
        sample = prepared(sample, self.settings)
        batch = collate([sample], self.settings, training=False)
        if batch.student is None:
            raise CheckpointError(complaint(self.path, "settings.role", "student", "teacher"))
        pillars = batch.student
        tensors = (pillars.points, pillars.pillar, pillars.coords, pillars.count)
        values = [*(tensor.numpy() for tensor in tensors), np.array([agent < 0 for agent in sample.agent_ids])]
        given = dict(zip(INPUTS, values, strict=True))
        fed = {name: value for name, value in given.items() if name in self._inputs}
        maps = _run(self.path, self._session, fed)
        direction = maps[2] if len(maps) > 2 else None
        parts = decode_maps(maps[0], maps[1], direction, self.settings, self._anchors)
        seen = join_detections(parts, self.settings.nms_iou) if self.settings.fusion == "late" else parts[0]
        return as_sensed(seen, sample, self.settings)


class PointsDetector:
    """Detector of another's ONNX file, of points to boxes; see the module's head.

    Attributes:
        settings: rules of its samples.
        classes: of what it detects.
    """

    classes = VEHICLES

    def __init__(self, path: Path, session: Any, metadata: dict[str, str]) -> None:
        self.path, self._session = path, session
        inputs, outputs = ({one.name for one in put} for put in (session.get_inputs(), session.get_outputs()))
        if inputs != {"points"} or not {"boxes", "score"} <= outputs:
            shown = f"{', '.join(sorted(inputs))} to {', '.join(sorted(outputs))}"
            expected = "a file of dsrc model export, or points to boxes and score"
            raise CheckpointError(complaint(path, "inputs", expected, shown))
        try:
            self.settings = SampleRequest(
                GridSpec(msgspec.json.decode(metadata["range_m"], type=_Range)),
                max_agents=msgspec.json.decode(metadata.get("max_agents", "1"), type=Annotated[int, Meta(ge=1)]),
            )
        except (KeyError, ValueError) as error:
            found = "none" if isinstance(error, KeyError) else str(error)
            raise CheckpointError(complaint(path, "metadata", "range_m, 6 numbers, and max_agents", found)) from None

    def detect(self, sample: Sample) -> Detections:
        """Detect in one sample, best first; raises DataError where the file gives no boxes."""
        boxes, score = _run(self.path, self._session, {"points": np.concatenate(sample.clouds)}, ["boxes", "score"])
        return of_arrays(boxes, score, (), self.settings.users, f"{self.path}: {sample.key}")


def open_onnx(path: Path) -> OnnxDetector | PointsDetector:
    """Open an ONNX file, of one thread on the CPU.

    Raises:
        CheckpointError: it is missing, damaged or no detector.
        SettingsError: ONNX Runtime is not installed.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: no such checkpoint file")
    try:
        runtime = import_module(_RUNTIME)
    except ImportError:
        hint = "; run: pip install 'dsrc-testbed[onnx]'"
        raise SettingsError(complaint(path, "packages", "onnxruntime", "none", hint)) from None
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        metadata = dict(session.get_modelmeta().custom_metadata_map)
    except Exception as error:  # of the runtime, which has a class of its own for each kind
        raise CheckpointError(unreadable(path, "ONNX file", error)) from None
    return (OnnxDetector if "settings" in metadata else PointsDetector)(path, session, metadata)


def runtime_version() -> str:
    """Return the version of ONNX Runtime."""
    return str(import_module(_RUNTIME).__version__)


def _run(path: Path, session: Any, given: dict[str, Any], outputs: list[str] | None = None) -> list[Any]:
    try:
        return session.run(outputs, given)
    except Exception as error:  # of the runtime
        raise DataError(unreadable(path, "network for this sample", error)) from None
