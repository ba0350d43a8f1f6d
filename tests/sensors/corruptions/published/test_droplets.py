"""Sizes and extinction of drops as published."""

import numpy as np
import pytest

from sensors.corruptions.published.droplets import ICE, WATER, efficiency, extinction, sizes_of
from tests.sensors.corruptions.published.goldens import arrays


@pytest.mark.parametrize(("law", "name"), [("marshall_palmer", "rain"), ("gunn_marshall", "snow")])
def test_extinction_and_number_of_drops_are_the_published_ones(law: str, name: str) -> None:
    golden = arrays("lisa_tables")
    for row, rate in enumerate(golden["rain_rates"]):
        sizes = sizes_of(law, rate)  # type: ignore[arg-type]
        assert np.isclose(sizes.number(0.05), golden[f"{name}_n_tot_dst0.05"][row], rtol=1e-12)
        assert np.isclose(extinction(sizes, halved=True), golden[f"{name}_alpha"][row], rtol=0.006)
        if name == "rain":
            assert np.isclose(extinction(sizes, halved=True), golden["rain_alpha"][row], rtol=2e-4)


def test_extinction_is_that_of_another_mie_code() -> None:
    golden = arrays("lisa_tables")
    ours = [extinction(sizes_of("marshall_palmer", rate)) for rate in golden["rain_rates"]]
    assert np.allclose(ours, golden["rain_alpha_pymiescatt"], rtol=2e-4)


def test_lisa_takes_half_the_size() -> None:
    golden = arrays("lisa_tables")
    size = np.pi * golden["D_mm"] / 905e-6
    small = size < 2.0
    assert np.allclose(efficiency(0.5 * size, WATER)[small], golden["q_ext"][small], rtol=1e-5)
    assert (efficiency(size, WATER)[small] > 5.0 * golden["q_ext"][small]).all()


def test_efficiency_starts_as_rayleigh_has_it_and_ends_at_twice_the_cross_section() -> None:
    tiny = np.array([0.02, 0.04])
    rayleigh = 8.0 / 3.0 * tiny**4 * ((WATER**2 - 1) / (WATER**2 + 2)) ** 2
    assert np.allclose(efficiency(tiny, WATER), rayleigh, rtol=2e-3)
    assert efficiency(np.array([1e6]), ICE)[0] == pytest.approx(2.0, abs=1e-3)
    # The series meets its mean: averaged over the ripple they are the same.
    size = np.linspace(40.0, 60.0, 2000)
    assert efficiency(size, WATER).mean() == pytest.approx((2.0 + 1.9924 * size ** (-2 / 3)).mean(), rel=0.01)


@pytest.mark.parametrize("law", ["marshall_palmer", "gunn_marshall", "sekhon_srivastava"])
def test_more_rain_takes_more_light(law: str) -> None:
    taken = [extinction(sizes_of(law, rate)) for rate in (0.2, 1.0, 5.0, 25.0)]  # type: ignore[arg-type]
    assert (np.diff(taken) > 0).all()
