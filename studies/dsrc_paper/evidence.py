"""Evidence for a vehicle in feature maps, and channels that never fire."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from dsrc.data.sample import Sample
from dsrc.models.detector import Detector, NetworkOutput
from dsrc.models.inputs.batch import collate
from dsrc.tables.table import Column, Table, TableRow

EvidenceFunction = Callable[[Sample], NDArray[np.float32]]
"""Function from a sample to a network's (h, w) evidence, see `vehicle_evidence`."""


@torch.inference_mode()
def vehicle_evidence(detector: Detector, sample: Sample, *, fused: bool = True) -> NDArray[np.float32]:
    """(h, w) evidence for a vehicle in each cell of the grid, y upwards and x to the right, logits, at least 0.

    The sum over the channels c of relu(w_c f_c), with f the feature after the shrink convolutions and w the weights of
    the class head, for the cell's anchor with the larger sum. The logit is this plus the negative terms and the bias.
    The mean of |f| is no evidence: it can be largest where the head is surest that a cell is empty.

    Args:
        detector: one that fuses stages, in evaluation mode.
        sample: its input.
        fused: evidence in the fused maps, else in the ego's own before fusion.
    """
    output = _output(detector, sample)
    if not fused:
        output = detector.heads(output.stages, [own[:1] for own in detector.maps(output.stages)])
    weight = detector.cls_head.weight[:, :, 0, 0]
    by_anchor = (weight[:, :, None, None] * output.fused[:1]).relu().sum(1)
    evidence = by_anchor.amax(0).float().cpu().numpy()
    # The maps of a network that was trained in the mirror image have y to the right.
    return np.ascontiguousarray(evidence[::-1]) if detector.settings.left_handed else evidence


@torch.inference_mode()
def firing_channels(detector: Detector, samples: Iterable[Sample]) -> NDArray[np.bool_]:
    """(C,) channels after the shrink convolutions above 0 in any cell of any sample."""
    fired = np.zeros(detector.cls_head.in_channels, bool)
    for sample in samples:
        fired |= (_output(detector, sample).fused > 0).any(3).any(2).any(0).cpu().numpy()
    return fired


def channel_table(networks: Mapping[str, Detector], samples: Sequence[Sample], dataset: str) -> Table:
    """Table of the channels after the shrink convolutions of each network, and of those that never fire."""
    columns = tuple(map(Column, ("Channels", "Never fire")))
    lines = []
    for name, network in networks.items():
        fired = firing_channels(network, samples)
        lines.append(TableRow(name, (len(fired), int((~fired).sum()))))
    note = (
        "Channels after the shrink convolutions, fused, and those that are above 0 in no cell of "
        f"{len(samples)} clean frames, evenly spread over the drives. The first training of each."
    )
    return Table("channels", f"Channels that never fire, {dataset}", "Network", columns, tuple(lines), note)


def _output(detector: Detector, sample: Sample) -> NetworkOutput:
    """Output of a network for a sample; a teacher reads clouds made with ground truth."""
    batch = collate([sample], detector.settings, training=False)
    pillars = batch.teacher if detector.settings.role == "teacher" else batch.student
    if pillars is None:
        raise ValueError("the batch has no clouds for this network")
    device = detector.cls_head.weight.device
    return detector(pillars.to(device), batch.layout.to(device))
