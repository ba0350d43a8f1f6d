"""Messages for a narrow channel: the tiles that their sender is surest of, in few bits."""

from typing import Any

import pytest
import torch
from msgspec.structs import replace
from torch import Tensor

from dsrc.models.channel import payload_of
from dsrc.models.compression import best_tiles, quantised, reduced, tiles, tiles_sent
from dsrc.models.detector import Detector, NetworkOutput
from dsrc.models.fusion import FUSIONS, AgentLayout
from dsrc.models.layers.encoder import Pillars
from dsrc.training.recipes import debug
from sim.radio import PRESETS
from tests.dsrc.models.storage.test_deploy import AGENTS, a_detector, some_pillars

SENDING = sorted(set(FUSIONS) - {"none", "early", "late", "mrcnet"})


def set_to(detector: Detector, **changes: Any) -> Detector:
    detector.settings = replace(detector.settings, **changes)
    return detector


def run(detector: Detector, pillars: Pillars, layout: AgentLayout = AgentLayout(AGENTS)) -> NetworkOutput:  # noqa: B008 - it is not changed
    with torch.inference_mode():
        return detector(pillars, layout)


def arrived(detector: Detector, pillars: Pillars) -> list[Tensor]:
    """Return what the fusion gets."""
    found = []
    detector.fusion.register_forward_pre_hook(lambda module, args: found.append([part.clone() for part in args[0]]))
    run(detector, pillars)
    return found[0]


@pytest.mark.parametrize("fusion", SENDING)
def test_as_many_tiles_arrive_as_were_promised(fusion: str) -> None:
    detector = set_to(a_detector(fusion=fusion), share=0.1)
    whole = arrived(a_detector(fusion=fusion), some_pillars(detector))
    parts = arrived(detector, some_pillars(detector))
    rows, columns = tiles(detector.settings)
    assert tiles_sent(detector.settings) == -(-rows * columns // 10)
    for part, full in zip(parts, whole, strict=True):
        torch.testing.assert_close(part[[0, 2]], full[[0, 2]])  # the egos' own
        there = torch.nn.functional.adaptive_max_pool2d((part[1:2] != 0).float().amax(1), (rows, columns))
        assert 0 < there.sum() <= tiles_sent(detector.settings)
        kept = part[1] != 0
        torch.testing.assert_close(part[1][kept], full[1][kept])


def test_what_is_not_sent_stays_empty_in_few_bits() -> None:
    maps = [torch.randn(2, 4, 8, 16)]
    maps[0][:, :, :, 5:] = 0.0
    (sent,) = reduced(maps, None, replace(debug().model, fusion="attention", bits=8))
    assert (sent[..., 5:] == 0.0).all() and (sent[..., :5] - maps[0][..., :5]).abs().max() < 0.03


def test_the_tiles_that_arrive_are_those_of_which_the_sender_is_surest() -> None:
    confidence = torch.zeros(1, 8, 16)
    confidence[0, 1, 2], confidence[0, 6, 13], confidence[0, 7, 0] = 0.9, 0.5, 0.4
    chosen = best_tiles(confidence, (2, 4), 2)
    assert chosen.nonzero().tolist() == [[0, 0, 0], [0, 1, 3]]


def test_who_hears_nothing_is_alone() -> None:
    detector = a_detector(fusion="max")
    pillars = some_pillars(detector)
    alone = run(detector, pillars, AgentLayout((1, 1, 1)))
    deaf = run(set_to(detector, share=0.0), pillars)
    # Maps end with a ReLU: nothing is less than what is not sent.
    torch.testing.assert_close(deaf.cls, alone.cls[[0, 2]], atol=1e-5, rtol=0)


@pytest.mark.parametrize(("bits", "error"), [(32, 0.0), (16, 1e-3), (8, 1 / 500)])
def test_few_bits_err_by_half_a_step_at_most(bits: int, error: float) -> None:
    x = torch.randn(2, 3, 10, 10) * torch.tensor([0.01, 1.0, 100.0])[:, None, None]
    reach = x.amax((2, 3), keepdim=True) - x.amin((2, 3), keepdim=True)
    assert ((quantised(x, bits) - x).abs() <= error * reach).all()
    assert quantised(torch.zeros(1, 1, 2, 2), bits).tolist() == torch.zeros(1, 1, 2, 2).tolist()


def test_all_tiles_in_full_are_what_they_were_and_training_has_everything() -> None:
    detector = a_detector()
    pillars = some_pillars(detector)
    expected = run(detector, pillars)
    torch.testing.assert_close(run(set_to(detector, share=1.0, bits=32), pillars).cls, expected.cls, atol=0, rtol=0)
    detector.train()
    before = arrived(detector, pillars)
    for part, full in zip(arrived(set_to(detector, share=0.1, bits=8), pillars), before, strict=True):
        torch.testing.assert_close(part, full, atol=1e-4, rtol=1e-4)


def test_a_message_has_the_bytes_of_its_tiles() -> None:
    settings = replace(debug().model, sdd=False, pcp=False, rec=False)
    spec = PRESETS["ideal"]
    values, channels = FUSIONS["attention"].values_sent(settings), sum(settings.stage_channels)
    rows, columns = tiles(settings)
    whole, tenth = payload_of(settings, spec)(None, 0), payload_of(replace(settings, share=0.1), spec)(None, 0)
    assert whole == 4 * values
    count = -(-rows * columns // 10)
    assert tenth == -(-4 * values * count // (rows * columns) - rows * columns // 8)
    eighth = payload_of(replace(settings, share=0.1, bits=8), spec)(None, 0)
    assert eighth == pytest.approx(values * count / (rows * columns) + rows * columns / 8 + 8 * channels, abs=1)


def test_what_sends_no_maps_has_none_to_choose_from() -> None:
    with pytest.raises(ValueError, match="share"):
        replace(debug().model, fusion="late", share=0.5, sdd=False, pcp=False, rec=False)
    with pytest.raises(ValueError, match="mrcnet"):
        replace(debug().model, fusion="mrcnet", share=0.5, sdd=False, pcp=False, rec=False)
    assert Detector(replace(debug().model, share=0.5)).settings.share == 0.5
