"""How the agents' feature maps become one: one file per method, each a `Fusion`."""

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

__all__ = ["FUSIONS", "AgentLayout", "Fusion"]

FUSIONS: dict[str, type[Fusion]] = {
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
}
