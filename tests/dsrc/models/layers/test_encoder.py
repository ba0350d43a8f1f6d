"""The pillar encoder equals the plain computation on padded pillars; empty clouds change nothing."""

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from dsrc.models.inputs.batch import pillars_of
from dsrc.models.layers.encoder import PillarEncoder
from dsrc.models.settings import ModelSettings
from dsrc.training.recipes import debug


def encoder(settings: ModelSettings) -> PillarEncoder:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        made = PillarEncoder(settings)
        torch.nn.init.normal_(made.norm.weight)
        torch.nn.init.normal_(made.norm.bias)
    return made


def cloud(points: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    # Few places, so that some pillars overflow.
    xy = rng.integers(-4, 5, (points, 2)) * 2.0 + rng.uniform(-0.3, 0.3, (points, 2))
    return np.concatenate([xy, rng.uniform(-2, 0.5, (points, 1)), rng.random((points, 1))], 1).astype(np.float32)


@pytest.mark.parametrize("padded", [False, True])
def test_training_statistics_and_gradients_equal_those_of_explicit_slots(padded: bool) -> None:
    settings = replace(debug().model, padded_slots=padded)
    pillars = pillars_of([cloud(3000), cloud(800, 1)], settings)
    ours = encoder(settings)
    features = ours.features(pillars)
    features.square().sum().backward()

    # In double precision: torch's own float32 statistics over many zero rows are off by 1e-3.
    plain = encoder(settings).double()
    norm = torch.nn.BatchNorm1d(settings.pillar_channels, eps=1e-3, momentum=settings.norm_momentum)
    norm.load_state_dict(encoder(settings).norm.state_dict())
    norm.double()
    x = plain.linear(ours.augment(pillars).double())
    rank = torch.cat([torch.arange(int(n)) for n in pillars.count])
    slots = x.new_zeros((len(pillars.count), 32, settings.pillar_channels)).index_put((pillars.pillar, rank), x)
    real = torch.arange(32) < pillars.count[:, None]
    if padded:
        expected = torch.relu(norm(slots.flatten(0, 1))).view_as(slots).amax(1)
    else:
        normed = torch.full_like(slots, -torch.inf).index_put((pillars.pillar, rank), norm(slots[real]))
        expected = torch.relu(normed.amax(1))
    expected.square().sum().backward()

    torch.testing.assert_close(features.double(), expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(ours.norm.running_mean.double(), norm.running_mean, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(ours.norm.running_var.double(), norm.running_var, rtol=1e-4, atol=1e-5)
    for found, wanted in ((ours.linear.weight, plain.linear.weight), (ours.norm.weight, norm.weight)):
        torch.testing.assert_close(
            found.grad.double(), wanted.grad, rtol=1e-3, atol=1e-3 * float(wanted.grad.abs().max())
        )


def test_an_empty_last_cloud_keeps_its_place_in_the_batch() -> None:
    settings = debug().model
    dense = encoder(settings).eval()(pillars_of([cloud(100), np.zeros((0, 4), np.float32)], settings))
    assert dense.shape == (2, settings.pillar_channels, settings.grid.height, settings.grid.width)
    assert dense[1].abs().max() == 0
    assert dense[0].abs().max() > 0


def test_nothing_but_empty_clouds_is_a_legal_batch() -> None:
    settings = debug().model
    dense = encoder(settings)(pillars_of([np.zeros((0, 4), np.float32)], settings))
    assert dense.shape[0] == 1
    assert dense.abs().max() == 0
