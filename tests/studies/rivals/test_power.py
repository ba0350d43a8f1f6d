import numpy as np
import pytest
from scipy import stats

from studies.rivals.power import pairs_for, power, power_table, spread_of


def test_the_power_is_the_share_of_drawn_experiments_that_find_the_effect() -> None:
    drawn = np.random.default_rng(1).normal(0.8, 1.0, (20_000, 6))
    found = stats.ttest_1samp(drawn, 0.0, axis=1).pvalue < 0.05
    assert power(0.8, 1.0, 6) == pytest.approx(found.mean(), abs=0.01)
    assert power(1e-9, 1.0, 6) == pytest.approx(0.05, abs=1e-3)


def test_a_larger_effect_never_needs_more_pairs() -> None:
    needed = [pairs_for(effect, 0.005) for effect in np.linspace(0.002, 0.06, 30)]
    assert needed == sorted(needed, reverse=True) and needed[-1] == 2


def test_a_spread_of_few_values_may_be_larger_than_it_looks() -> None:
    found, most = spread_of([0.0, 1.0, 2.0])
    assert found == pytest.approx(1.0) and most > found
    assert spread_of(np.random.default_rng(0).normal(size=5000).tolist())[1] == pytest.approx(1.0, abs=0.05)


def test_the_pairs_that_exist_give_the_published_gains() -> None:
    gains = [100 * row.cells[0] for row in power_table().rows if isinstance(row.cells[0], float)]
    assert gains == pytest.approx([1.7, 1.4, 1.0, 1.0], abs=0.06)
