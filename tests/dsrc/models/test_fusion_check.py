"""Fusion methods of one's own: registration by a program or an entry point, and the check of their contract."""

import re
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch
from msgspec.structs import replace
from torch import Tensor, nn

from dsrc.models.detector import Detector
from dsrc.models.fusion import FUSIONS, AgentLayout, Fusion, register_fusion
from dsrc.models.fusion.base import stacked_maps
from dsrc.models.fusion.warp import into_ego
from dsrc.models.fusion_check import check_fusion
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.checkpoint import load_detector, save_detector
from dsrc.training.recipes import debug, override
from sim.errors import SettingsError


class MeanFusion(Fusion):
    """Mean over the agents: what another package may bring."""

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        groups = layout.split(features)
        return stacked_maps([into_ego(group, layout, b).mean(0) for b, group in enumerate(groups)])


class GatedFusion(MeanFusion):
    """The ego's map and a learned share of the mean."""

    place = "map"
    start = "identity"

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.share = nn.Parameter(torch.zeros(channels))

    @classmethod
    def from_settings(cls, settings: ModelSettings) -> "GatedFusion":
        return cls(settings.shrink_channels)

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        own = torch.stack([group[0] for group in layout.split(features)])
        return own + self.share[:, None, None] * super().fuse(features, layout)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is gone after it."""
    monkeypatch.setattr(FUSIONS, "_values", dict(FUSIONS._values))


@pytest.mark.parametrize("fusion", [MeanFusion, GatedFusion])
def test_a_fusion_of_ones_own_passes(fusion: type[Fusion]) -> None:
    check_fusion(fusion)


@pytest.mark.parametrize("name", sorted(set(FUSIONS) - {"early", "late"}))
def test_every_built_in_fusion_of_maps_passes(name: str) -> None:
    check_fusion(FUSIONS[name])


class WrongShape(MeanFusion):
    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        return super().fuse(features, layout)[..., 1:]


class LastWins(MeanFusion):
    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        return stacked_maps([into_ego(group, layout, b)[-1] for b, group in enumerate(layout.split(features))])


class NeedsTwo(MeanFusion):
    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        groups = [into_ego(group, layout, b) for b, group in enumerate(layout.split(features))]
        return stacked_maps([group[0] + group[1:].sum(0) / (len(group) - 1) for group in groups])


class BlindToPoses(MeanFusion):
    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        return stacked_maps([group.amax(0) for group in layout.split(features)])


class Mixing(MeanFusion):
    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        return super().fuse(features, layout) + features.mean()


class InPlace(MeanFusion):
    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        return super().fuse(features.detach().mul_(0.5), layout)


class Noisy(MeanFusion):
    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        return super().fuse(features, layout) + torch.randn(())


class Detached(GatedFusion):
    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        return super().fuse(features, layout) - self.share.detach()[:, None, None] - features.sum() + features.sum()

    def __init__(self, channels: int) -> None:
        super().__init__(channels)
        self.unused = nn.Parameter(torch.zeros(3))


class UnlikeItsStart(GatedFusion):
    start = "maximum"


class TooMuch(MeanFusion):
    @classmethod
    def values_sent(cls, settings: ModelSettings) -> int:
        return 10**9


class Nowhere(MeanFusion):
    place = "roof"  # type: ignore[assignment]


class NoDefault(MeanFusion):
    def __init__(self, channels: int) -> None:
        super().__init__()


@pytest.mark.parametrize(
    ("fusion", "line"),
    [
        (WrongShape, r"^WrongShape: shapes: expected \[\(2, 16, 20, 36\), .*found \[\(2, 16, 20, 35\)"),
        (LastWins, "^LastWins: order: the result depends on the order of the collaborators"),
        (NeedsTwo, "^NeedsTwo: alone: expected finite numbers"),
        (BlindToPoses, "^BlindToPoses: poses: the collaborators' poses .* have no effect"),
        (Mixing, "^Mixing: samples: a sample depends on others of its batch"),
        (InPlace, "^InPlace: inputs: changes its input maps"),
        (Noisy, "^Noisy: inputs: a second call in eval mode gives another result"),
        (Detached, "^Detached: gradients: no gradient for unused"),
        (UnlikeItsStart, "^UnlikeItsStart: start: untrained output is not the maximum"),
        (TooMuch, "^TooMuch: values_sent: expected 0 to .* numbers of a frame, found 1000000000"),
        (Nowhere, "^Nowhere: class: place: expected 'stages' or 'map', found 'roof'$"),
        (
            NoDefault,
            r"^NoDefault: from_settings: raised TypeError: .*missing 1 required positional argument: 'channels'$",
        ),
        (nn.Linear, "^Linear: class: expected a subclass of dsrc.models.fusion.Fusion$"),
    ],
)
def test_a_broken_rule_is_one_line(fusion: type[Fusion], line: str) -> None:
    with pytest.raises(SettingsError) as failed:
        check_fusion(fusion)
    assert any(re.search(line, one) for one in str(failed.value).split("\n")), failed.value
    assert all(one.startswith(f"{fusion.__name__}: ") for one in str(failed.value).split("\n"))


def test_a_check_leaves_no_trace() -> None:
    names, state = list(FUSIONS), torch.get_rng_state()
    check_fusion(MeanFusion)
    assert list(FUSIONS) == names and torch.equal(torch.get_rng_state(), state)


def test_a_registered_fusion_is_one_like_all_others(registered: None, tmp_path: Path) -> None:
    register_fusion("gated", GatedFusion)
    register_fusion("gated", GatedFusion)  # a module that is imported twice
    recipe = override(debug(), ["fusion=gated", "sdd=false", "pcp=false", "rec=false"])
    save_detector(tmp_path / "detector.pt", Detector(recipe.model))
    assert isinstance(load_detector(tmp_path / "detector.pt").fusion, GatedFusion)
    assert "gated" in FUSIONS and list(FUSIONS)[-1] == "gated"


def test_a_name_belongs_to_one_fusion(registered: None) -> None:
    with pytest.raises(SettingsError, match=r"^dsrc\.fusions: name: expected a new one, found 'max'"):
        register_fusion("max", MeanFusion)
    with pytest.raises(
        SettingsError, match=r"^register_fusion: linear: expected a subclass of dsrc.models.fusion.Fusion"
    ):
        register_fusion("linear", nn.Linear)


def test_settings_name_the_nearest_fusion() -> None:
    with pytest.raises(ValueError, match=r"^fusion: unknown 'maxx'; did you mean 'max'\?$"):
        replace(debug().model, fusion="maxx")
    with pytest.raises(SettingsError, match=r"^--set: model.fusion: unknown 'atention'; did you mean 'attention'\?"):
        override(debug(), ["fusion=atention"])
    with pytest.raises(SettingsError, match=r"^--set: model.fusion: expected str, found 3"):
        override(debug(), ["fusion=3"])


def test_an_installed_package_brings_its_fusion(registered: None, monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"mean": MeanFusion, "linear": nn.Linear}
    points = {name: EntryPoint(name, f"{__name__}:{name}", FUSIONS.group) for name in values}
    monkeypatch.setitem(FUSIONS.__dict__, "_installed", points)
    monkeypatch.setattr(EntryPoint, "load", lambda point: values[point.name])
    assert isinstance(Detector(replace(debug().model, fusion="mean")).fusion, MeanFusion)
    with pytest.raises(SettingsError, match=r"linear: .* expected a subclass of dsrc\.models\.fusion\.Fusion"):
        Detector(replace(debug().model, fusion="linear"))
