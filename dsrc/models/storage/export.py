"""ONNX export of detectors, for runtimes without PyTorch.

Inputs are the pillars of one sample, as of `dsrc.models.inputs.batch.pillars_of`; outputs are the heads' maps before
thresholds and suppression. Where the settings say `left_handed`, the network's frame has y to the right, and the caller
mirrors points and boxes; where they name `intensity_steps`, the caller rounds; where they say `height` of `ground`, the
caller levels clouds and puts boxes back. Numbers of points and pillars are dynamic; that of agents too where the method
allows it.
"""

import importlib.util
import logging
import warnings
from pathlib import Path

import msgspec
import torch
from torch import Tensor, nn

from dsrc.models.detector import Detector
from dsrc.models.fusion import AgentLayout
from dsrc.models.layers.encoder import Pillars
from sim.errors import SettingsError, complaint
from sim.files import replacing

INPUTS = {
    "points": "(P, 4) float32 x, y, z, m, in the ego LiDAR's frame as trained, and intensity; pillar by pillar",
    "pillar": "(P,) int64 row of each point's pillar, ascending",
    "coords": "(V, 3) int64 agent, row (y) and column (x) of each pillar",
    "count": "(V,) int64 points in each pillar, at least 1",
    "roadside": "(N,) bool whether an agent is a roadside unit, the ego first",
}
"""Inputs: P points, V pillars, N agents."""
OUTPUTS = {
    "cls": "(1, 2, h, w) logits, one per anchor; (N, 2, h, w) of methods that detect in each cloud alone",
    "reg": "(1, 14, h, w) box residuals, 7 per anchor",
    "direction": "(1, 2, h, w) logits of a box that heads against its anchor, with a direction head",
}
"""Outputs."""

_ANY_NUMBER = ("none", "early", "late", "max", "attention", "coalign")
_FIXED_NUMBER = ("v2vnet", "where2comm", "mrcnet")


class _Network(nn.Module):
    """Detector with plain tensors as inputs and outputs."""

    def __init__(self, detector: Detector) -> None:
        super().__init__()
        self.detector = detector

    def forward(
        self, points: Tensor, pillar: Tensor, coords: Tensor, count: Tensor, roadside: Tensor
    ) -> tuple[Tensor, ...]:
        agents = roadside.shape[0]
        layout = AgentLayout((agents,), roadside=roadside)
        output = self.detector(Pillars(points, pillar, coords, count, agents), layout)
        return tuple(part for part in (output.cls, output.reg, output.direction) if part is not None)


def export_onnx(detector: Detector, out: Path, agents: int = 2) -> str:
    """Write an ONNX file atomically.

    Args:
        detector: detector of `load_detector`, on a CPU.
        out: the file; its metadata entry `settings` holds the detector's settings in JSON.
        agents: number of agents, for a method that needs a fixed one.

    Returns:
        The number of agents that the file accepts, or "any number".

    Raises:
        SettingsError: packages are missing, or the method has no ONNX form or not for this number of agents.
    """
    fusion = detector.settings.fusion
    if fusion not in (*_ANY_NUMBER, *_FIXED_NUMBER):
        expected = f"one of {', '.join((*_ANY_NUMBER, *_FIXED_NUMBER))}"
        raise SettingsError(complaint("export", "fusion", expected, fusion))
    if detector.settings.own_frame or detector.settings.role == "teacher":
        raise SettingsError(complaint("export", "detector", "a student that gets clouds in the ego's frame", "another"))
    is_open, most = fusion in _ANY_NUMBER, detector.settings.max_agents
    if not is_open and not 1 <= agents <= most:
        raise SettingsError(complaint("export", "agents", f"1 to {most}", agents))
    for package in ("onnx", "onnxscript"):
        if importlib.util.find_spec(package) is None:
            hint = "; run: pip install onnx onnxscript onnxruntime"
            raise SettingsError(complaint("export", "packages", package, "none", hint))
    network = _Network(detector.eval())
    dims = {name: torch.export.Dim(name, min=2) for name in ("points", "pillars")}
    number = torch.export.Dim("agents", min=1, max=max(most, 2)) if is_open else None
    shapes = {
        "points": {0: dims["points"]},
        "pillar": {0: dims["points"]},
        "coords": {0: dims["pillars"]},
        "count": {0: dims["pillars"]},
        "roadside": {0: number} if number is not None else None,
    }
    # The exporter warns of packages that are not needed.
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            program = torch.export.export(
                network, _example(2 if is_open else agents), dynamic_shapes=shapes, strict=False
            )
            names = list(OUTPUTS)[: 2 if detector.direction_head is None else 3]
            made = torch.onnx.export(program, dynamo=True, verbose=False, input_names=list(INPUTS), output_names=names)
    finally:
        logger.setLevel(level)
    if made is None:
        raise RuntimeError("PyTorch's exporter gave nothing")
    made.model.metadata_props["settings"] = msgspec.json.encode(detector.settings).decode()
    made.model.metadata_props["agents"] = "any number" if is_open else str(agents)
    made.model.producer_name = "dsrc-testbed"
    with replacing(out) as temporary:
        made.save(temporary)
    return made.model.metadata_props["agents"]


def _example(agents: int) -> tuple[Tensor, ...]:
    """Return example inputs, of which only shapes and types matter."""
    coords = torch.tensor([[agent, 0, column] for agent in range(agents) for column in range(3)])
    count = torch.full((len(coords),), 2)
    pillar = torch.arange(len(coords)).repeat_interleave(2)
    return torch.zeros(len(pillar), 4), pillar, coords, count, torch.zeros(agents, dtype=torch.bool)
