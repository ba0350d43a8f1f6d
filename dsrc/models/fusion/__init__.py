"""Fusion methods: feature maps of several agents to one; one file per method, each a `Fusion`."""

from collections.abc import Mapping

from dsrc.models.fusion.attention import AttentionFusion
from dsrc.models.fusion.base import AgentLayout, Fusion
from dsrc.models.fusion.coalign import CoAlign
from dsrc.models.fusion.cobevt import CoBEVT
from dsrc.models.fusion.early import EarlyFusion
from dsrc.models.fusion.ermvp import ERMVP
from dsrc.models.fusion.late import LateFusion
from dsrc.models.fusion.max import MaxFusion, MaxMapFusion
from dsrc.models.fusion.mrcnet import MRCNetStyle
from dsrc.models.fusion.none import NoFusion
from dsrc.models.fusion.v2vnet import V2VNet
from dsrc.models.fusion.v2xvit import V2XViT
from dsrc.models.fusion.where2comm import Where2comm
from dsrc.models.registry import FUSIONS as _ALL
from dsrc.models.registry import register_fusion

__all__ = ["FUSIONS", "AgentLayout", "Fusion", "register_fusion"]

FUSIONS: Mapping[str, type[Fusion]] = _ALL
"""Fusion classes by name, built in and registered."""

for _name, _fusion in {
    "none": NoFusion,
    "early": EarlyFusion,
    "late": LateFusion,
    "max": MaxFusion,
    "max_map": MaxMapFusion,
    "attention": AttentionFusion,
    "v2vnet": V2VNet,
    "v2xvit": V2XViT,
    "cobevt": CoBEVT,
    "where2comm": Where2comm,
    "coalign": CoAlign,
    "ermvp": ERMVP,
    "mrcnet": MRCNetStyle,
}.items():
    register_fusion(_name, _fusion)
