"""Contract check of fusion methods, of one's own in particular, as gymnasium's `check_env` of environments."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from msgspec.structs import replace as changed
from torch import Tensor

from dsrc.models.detector import Detector
from dsrc.models.fusion import FUSIONS, AgentLayout, Fusion, register_fusion
from dsrc.models.settings import ModelSettings
from dsrc.ops.grid import GridSpec
from sim.errors import SettingsError

SMALL = ModelSettings(
    # Windows of 4, 8 or 16 cells divide none of the maps.
    grid=GridSpec(range_m=(-14.4, -8.0, -3.0, 14.4, 8.0, 1.0)),
    pillar_channels=8,
    stage_channels=(16, 16, 16),
    stage_blocks=(1, 1, 1),
    decoder_channels=16,
    shrink_channels=16,
    sdd=False,
    pcp=False,
    rec=False,
)
_AGENTS = (3, 2)
_FAR_M = 1000.0


def check_fusion(fusion: type[Fusion], settings: ModelSettings = SMALL) -> None:
    """Check a fusion class against the contract of `Fusion`.

    Checked are the class itself, its untrained output (`start`), shapes, an ego alone, independence of samples and of
    the collaborators' order (unless `ordered`), lost maps, poses (unless the collaborators do not matter), inputs left
    as they were, numbers sent and gradients. All run on random maps, on the CPU, in a second or two.

    Args:
        fusion: the class; it need not be registered.
        settings: of the detector around it; its `fusion` is not read.

    Raises:
        SettingsError: one line per failure.
    """
    if isinstance(fusion, type) and issubclass(fusion, Fusion):
        failures = _Check(fusion, settings).failures()
    else:
        failures = ["class: expected a subclass of dsrc.models.fusion.Fusion"]
    if failures:
        name = getattr(fusion, "__name__", repr(fusion))
        raise SettingsError("\n".join(f"{name}: {line}" for line in failures))


class _Failure(Exception):
    """Broken rule of the contract."""


class _Check:
    """Rules of the contract, run on one class."""

    def __init__(self, fusion: type[Fusion], settings: ModelSettings) -> None:
        self.cls, self.settings = fusion, settings
        self.extent_m = (settings.grid.cell_m * settings.grid.width, settings.grid.cell_m * settings.grid.height)

    def failures(self) -> list[str]:
        """Return a line for each broken rule; without a working detector, only why there is none."""
        lines = self._run({"class": self._class})
        if lines:
            return lines
        with torch.random.fork_rng(devices=[]), _registered(self.cls) as name:
            torch.manual_seed(0)
            lines = self._run({"from_settings": lambda: self._make(name)})
            if lines:
                return lines
            return self._run(
                {
                    "values_sent": self._values_sent,
                    "start": self._start,
                    "shapes": self._shapes,
                    "alone": self._alone,
                    "inputs": self._inputs,
                    "samples": self._samples,
                    "order": self._order,
                    "lost": self._lost,
                    "poses": self._poses,
                    "gradients": self._gradients,
                }
            )

    def _run(self, rules: dict[str, Callable[[], None]]) -> list[str]:
        lines = []
        for name, rule in rules.items():
            try:
                rule()
            except _Failure as failure:
                lines.append(f"{name}: {failure}")
            except Exception as error:  # whatever a foreign class does is a failure of its rule
                first = str(error).partition("\n")[0]
                lines.append(f"{name}: raised {type(error).__name__}: {first}")
        return lines

    def _class(self) -> None:
        _expect(self.cls.place in ("stages", "map"), f"place: expected 'stages' or 'map', found {self.cls.place!r}")
        starts = ("", "identity", "maximum")
        _expect(self.cls.start in starts, f"start: expected one of {starts}, found {self.cls.start!r}")

    def _make(self, name: str) -> None:
        self.detector = Detector(changed(self.settings, fusion=name)).eval()
        self.maps = [part.relu() for part in self._random_maps(sum(_AGENTS))]

    def _random_maps(self, rows: int) -> list[Tensor]:
        """Return (rows, C, H, W) maps of the sizes that agents send."""
        height, width = self.settings.grid.height, self.settings.grid.width
        if self.cls.place == "map":
            return [torch.randn(rows, self.settings.shrink_channels, height // 4, width // 4)]
        channels = self.settings.stage_channels
        return [torch.randn(rows, c, height >> k, width >> k) for k, c in enumerate(channels, start=1)]

    def _fused(self, maps: Sequence[Tensor], layout: AgentLayout) -> list[Tensor]:
        with torch.no_grad():
            return self.detector.fuse(maps, layout)

    def _stir(self) -> None:
        """Move all weights of the method, as training does: an untrained one may ignore the collaborators."""
        generator = torch.Generator().manual_seed(0)
        for weight in self.detector.fusion.parameters():
            weight.data += 0.1 * torch.randn(weight.shape, generator=generator)

    def _values_sent(self) -> None:
        sent = self.cls.values_sent(self.settings)
        most = sum(part[0].numel() for part in self.maps)
        _expect(isinstance(sent, int) and 0 <= sent <= most, f"expected 0 to {most} numbers of a frame, found {sent!r}")

    def _start(self) -> None:
        weights = any(True for _ in self.detector.fusion.parameters())
        _expect(bool(self.cls.start) == weights, "expected `start` of a class with weights, and of no other")
        if not self.cls.start:
            return
        found = self._fused(self.maps, AgentLayout(_AGENTS))
        for part, fused in zip(self.maps, found, strict=True):
            groups = part.split(list(_AGENTS))
            rows = [group[0] if self.cls.start == "identity" else group.amax(0) for group in groups]
            _same(fused, torch.stack(rows), f"untrained output is not the {self.cls.start}", 0.0)

    def _shapes(self) -> None:
        found = self._fused(self.maps, AgentLayout(_AGENTS))
        wanted = [(len(_AGENTS), *part.shape[1:]) for part in self.maps]
        _expect(_shapes_of(found) == wanted, f"expected {wanted}, found {_shapes_of(found)}")
        _finite(found)
        _expect(all(part.dtype == self.maps[0].dtype for part in found), "expected the dtype of the maps")

    def _alone(self) -> None:
        alone = [part[:1] for part in self.maps]
        found = self._fused(alone, AgentLayout((1,)))
        _expect(_shapes_of(found) == _shapes_of(alone), f"expected {_shapes_of(alone)}, found {_shapes_of(found)}")
        _finite(found)

    def _inputs(self) -> None:
        before = [part.clone() for part in self.maps]
        one, other = (self._fused(self.maps, AgentLayout(_AGENTS)) for _ in range(2))
        _expect(all(torch.equal(a, b) for a, b in zip(before, self.maps, strict=True)), "changes its input maps")
        _each_same(one, other, "a second call in eval mode gives another result")

    def _samples(self) -> None:
        self._stir()
        both = self._fused(self.maps, AgentLayout(_AGENTS))
        start = 0
        for row, count in enumerate(_AGENTS):
            own = self._fused([part[start : start + count] for part in self.maps], AgentLayout((count,)))
            _each_same([part[row : row + 1] for part in both], own, "a sample depends on others of its batch")
            start += count

    def _order(self) -> None:
        if self.cls.ordered:
            return
        turned = [part[[0, 2, 1, 3, 4]] for part in self.maps]
        one, other = (self._fused(maps, AgentLayout(_AGENTS)) for maps in (self.maps, turned))
        _each_same(one, other, "the result depends on the order of the collaborators; set `ordered` if it has to")

    def _lost(self) -> None:
        grid = self.settings.grid
        tiles = torch.zeros(sum(_AGENTS), grid.height // 8, grid.width // 8, dtype=torch.bool)
        tiles[1:3] = tiles[4:] = True
        layout = AgentLayout(_AGENTS, lost=tiles)
        found = self._fused(self.maps, layout)
        _finite(found, " without any collaborator's map")
        rows = torch.tensor([0, 3])
        other = [part.roll(1, 0).index_copy(0, rows, part[rows]) for part in self.maps]
        _each_same(found, self._fused(other, layout), "reads maps of collaborators that were lost")

    def _poses(self) -> None:
        still = self._fused(self.maps, AgentLayout(_AGENTS))
        _each_same(self._at(0.0), still, "equal poses give another result than maps in the ego's frame", 1e-3)
        far = self._at(_FAR_M)
        _finite(far, f" at {_FAR_M:.0f} m")
        alone = self._fused([part[[0, 3]] for part in self.maps], AgentLayout((1, 1)))
        if _differ(alone, still):
            moved = _differ(self._at(4.0), still)
            _expect(moved, "the collaborators' poses (`layout.pairwise`) have no effect; see `fusion.warp.into_ego`")

    def _at(self, ahead_m: float) -> list[Tensor]:
        """Return the result with the collaborators one behind the other, so far apart."""
        most = max(_AGENTS)
        along = ahead_m * torch.arange(most, dtype=torch.float64)
        pairwise = torch.eye(4, dtype=torch.float64).expand(len(_AGENTS), most, most, 4, 4).clone()
        pairwise[..., 0, 3] = along[:, None] - along
        return self._fused(self.maps, AgentLayout(_AGENTS, pairwise=pairwise, extent_m=self.extent_m))

    def _gradients(self) -> None:
        fusion = self.detector.fusion.train()
        maps = [part.clone().requires_grad_() for part in self.maps]
        roadside, delay = torch.tensor([False, True, False, True, False]), torch.tensor([0, 1, 2, 0, 1])
        layout = AgentLayout(_AGENTS, roadside=roadside, delay=delay)
        sum(part.square().mean() for part in self.detector.fuse(maps, layout)).backward()  # type: ignore[union-attr]
        without = [name for name, weight in fusion.named_parameters() if weight.grad is None]
        _expect(not without, f"no gradient for {', '.join(without)}")
        wrong = [n for n, w in fusion.named_parameters() if w.grad is not None and not bool(w.grad.isfinite().all())]
        _expect(not wrong, f"gradient is not finite for {', '.join(wrong)}")
        _expect(maps[0].grad is not None and bool(maps[0].grad.any()), "no gradient for the maps")


@contextmanager
def _registered(fusion: type[Fusion]) -> Iterator[str]:
    name = f"check of {fusion.__name__}"
    register_fusion(name, fusion)
    try:
        yield name
    finally:
        FUSIONS.remove(name)


def _expect(holds: bool, line: str) -> None:
    if not holds:
        raise _Failure(line)


def _finite(maps: Sequence[Tensor], where: str = "") -> None:
    _expect(all(bool(part.isfinite().all()) for part in maps), f"expected finite numbers{where}")


def _differ(some: Sequence[Tensor], others: Sequence[Tensor]) -> bool:
    return any(not torch.allclose(a, b, atol=1e-4) for a, b in zip(some, others, strict=True))


def _shapes_of(maps: Sequence[Tensor]) -> list[tuple[int, ...]]:
    return [tuple(part.shape) for part in maps]


def _same(found: Tensor, wanted: Tensor, line: str, atol: float = 1e-4) -> None:
    _expect(found.shape == wanted.shape, f"{line}: shape {tuple(found.shape)} for {tuple(wanted.shape)}")
    off = float((found - wanted).abs().max()) if found.numel() else 0.0
    _expect(off <= atol * max(1.0, float(wanted.abs().max())), f"{line}, by up to {off:.2g}")


def _each_same(found: Sequence[Tensor], wanted: Sequence[Tensor], line: str, atol: float = 1e-4) -> None:
    for one, other in zip(found, wanted, strict=True):
        _same(one, other, line, atol)
