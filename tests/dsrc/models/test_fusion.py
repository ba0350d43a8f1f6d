"""Fusion methods against the reference and against what they must not depend on."""

import numpy as np
import pytest
import torch

from dsrc.models.fusion import FUSIONS
from tests.dsrc.models.reference import golden


def test_attention_and_max_equal_the_reference() -> None:
    arrays, notes = golden("fuse_att_max")
    agents, x = tuple(notes["record_len"]), torch.from_numpy(arrays["x"])
    np.testing.assert_allclose(FUSIONS["attention"](x, agents).numpy(), arrays["att"], atol=1e-5)
    np.testing.assert_allclose(FUSIONS["attention"](x * 3, agents).numpy(), arrays["att_x3"], atol=1e-5)
    np.testing.assert_array_equal(FUSIONS["max"](x, agents).numpy(), arrays["max"])


@pytest.mark.parametrize("name", ["attention", "max", "none"])
def test_an_ego_without_company_keeps_its_features(name: str) -> None:
    x = torch.randn(2, 4, 3, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(FUSIONS[name](x, (1, 1)), x)


@pytest.mark.parametrize("name", ["attention", "max"])
def test_the_order_of_the_collaborators_does_not_matter(name: str) -> None:
    x = torch.randn(4, 8, 3, 3, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(FUSIONS[name](x, (4,)), FUSIONS[name](x[[0, 3, 1, 2]], (4,)))


def test_late_fusion_leaves_every_cloud_alone() -> None:
    x = torch.randn(3, 4, 2, 2, generator=torch.Generator().manual_seed(3))
    assert FUSIONS["late"](x, (1, 1, 1)) is x
