"""Detections of every team of an ego and some of its collaborators, each cloud encoded once."""

from dataclasses import replace
from typing import Any

import torch

from dsrc.data.sample import Sample, SampleDetector
from dsrc.models.detector import Detector
from dsrc.models.fusion import AgentLayout
from dsrc.models.fusion.late import join_detections
from dsrc.models.inputs.batch import collate, with_agents
from dsrc.models.inputs.trained_frame import as_sensed, prepared
from dsrc.models.settings import fusion_of
from dsrc.ops.detections import Detections

Team = tuple[int, ...]


def teams_of(agents: int) -> list[Team]:
    """Return the 2^(A - 1) teams of A agents: rows, ascending, the ego's 0 first; bit i of its number is row i + 1."""
    others = range(agents - 1)
    return [(0, *(i + 1 for i in others if k >> i & 1)) for k in range(2 ** max(agents - 1, 0))]


@torch.inference_mode()
def team_detections(detector: SampleDetector, sample: Sample) -> list[Detections]:
    """Detections of each team of a sample's agents, in the order of `teams_of`, in the ego LiDAR's frame.

    Each is `detector.detect` of the sample without the others. Methods that fuse maps or boxes encode every cloud once;
    early fusion, corrected poses and detectors of one's own run once per team.
    """
    teams = teams_of(len(sample.clouds))
    fusion = fusion_of(detector.settings)
    if fusion == "none":
        return [detector.detect(sample)] * len(teams)
    if not isinstance(detector, Detector) or fusion == "early" or detector.settings.align_poses:
        return [detector.detect(with_agents(sample, team)) for team in teams]
    settings, device = detector.settings, detector.cls_head.weight.device
    sample = prepared(sample, settings)
    batch = collate([sample], settings, training=False).to(device)
    if batch.student is None:
        raise ValueError("a teacher reads clouds that are made with ground truth: it cannot detect in a sample")
    if fusion == "late":
        parts = detector.decode(detector(batch.student, batch.layout))
        found = [join_detections([parts[row] for row in team], settings.nms_iou) for team in teams]
    else:
        found = []
        with torch.autocast(device.type, detector.precision, enabled=detector.precision != torch.float32):
            stages = detector.backbone(detector.encoder(batch.student))
            maps = detector.maps(stages)
            for team in teams:
                rows = torch.tensor(team, device=device)
                fused = detector.fuse([part[rows] for part in maps], team_layout(batch.layout, team))
                found += detector.decode(detector.heads(stages, fused).float())
    return [as_sensed(part, with_agents(sample, team), settings) for part, team in zip(found, teams, strict=True)]


def team_layout(layout: AgentLayout, team: Team) -> AgentLayout:
    """Layout of a team of the agents of one sample."""
    rows = torch.tensor(team)
    per_agent: dict[str, Any] = {
        name: None if (part := getattr(layout, name)) is None else part[rows.to(part.device)]
        for name in ("lost", "roadside", "delay")
    }
    pairwise = layout.pairwise
    if pairwise is not None:
        pairwise = pairwise[:, rows.to(pairwise.device)][:, :, rows.to(pairwise.device)]
    return replace(layout, agents=(len(team),), pairwise=pairwise, **per_agent)
