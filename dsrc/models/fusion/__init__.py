"""Fusion methods: feature maps of several agents to one; one file per method, each a `Fusion`."""

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
from dsrc.models.settings import ModelSettings
from sim.catalog.registry import Registry, import_path
from sim.errors import SettingsError

__all__ = ["FUSIONS", "AgentLayout", "Fusion", "register_fusion"]


def _fusion(value: object) -> type[Fusion]:
    if not (isinstance(value, type) and issubclass(value, Fusion)):
        raise TypeError(f"expected a subclass of dsrc.models.fusion.Fusion, found {value!r}")
    return value


FUSIONS: Registry[type[Fusion]] = Registry(
    "dsrc.fusions",
    {
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
    },
    _fusion,
    key=import_path,
)
"""Fusion classes by name, built in and registered."""
ModelSettings.fusions = FUSIONS


def register_fusion(name: str, fusion: type[Fusion]) -> None:
    """Add a fusion class, whose name `ModelSettings.fusion` then accepts.

    It holds for this process; other processes and machines need it too: an entry point of the group `dsrc.fusions`,
    `name = "package.module:Class"`, is found by all of them.

    Args:
        name: in settings, recipes and on the command line.
        fusion: `dsrc.models.fusion_check.check_fusion` tests it.

    Raises:
        SettingsError: the name is taken, or the class is not a fusion.
    """
    try:
        FUSIONS.register(name, _fusion(fusion))
    except TypeError as error:
        raise SettingsError(f"register_fusion: {name}: {error}") from None
