"""Echoes of fog and of targets as published."""

import numpy as np
import pytest

from sensors.corruptions.physics.receiver import overlap
from sensors.corruptions.published.echo import TARGET_BACKSCATTER, soft_integral
from tests.sensors.corruptions.published.goldens import arrays, table


def test_the_backscatter_of_a_target_is_the_published_one() -> None:
    assert np.isclose(TARGET_BACKSCATTER, arrays("fog_theory")["beta_0"], rtol=1e-12)


@pytest.mark.parametrize("pulse", range(3))
def test_the_echo_of_fog_is_the_published_integral(pulse: int) -> None:
    golden = arrays("fog_theory")
    for alpha, by_target in zip(golden["alpha"], golden["soft_integral"][pulse], strict=True):
        for target, theirs in zip(golden["R0"], by_target, strict=True):
            ours = soft_integral(golden["R"], np.array(target), alpha, golden["tau_h"][pulse])
            assert np.allclose(ours, theirs, rtol=1e-9, atol=1e-9 * theirs.max())


def test_the_receiver_sees_from_a_metre_on() -> None:
    for reach, share in (
        (arrays("fog_theory")["xsi_R"], arrays("fog_theory")["xsi"]),
        (np.array(table("snow_formulas")["xsi_R"]), np.array(table("snow_formulas")["xsi"])),
    ):
        assert np.allclose(overlap(reach), share, atol=1e-12)


def test_fog_without_end_echoes_like_fog_before_a_far_target() -> None:
    reach = np.linspace(0.5, 40.0, 80)
    endless = soft_integral(reach, np.array(np.inf), 0.03, 2e-8)
    assert np.allclose(endless, soft_integral(reach, np.array(40.5), 0.03, 2e-8), rtol=1e-12)
