"""Plots of the paper: points stand where their numbers are, bars at the mean of all methods."""

import numpy as np
import pytest

from studies.dsrc_paper.figures import mean_bars, table_dots
from tests.dsrc.evaluation.test_figures import some_rows, some_sheet


def test_points_of_a_sheet_stand_on_its_lines_and_fill_the_axis() -> None:
    sheet = some_sheet(("none", "SDD", "SDD + PCP"))
    figure = table_dots(sheet)
    assert [t.get_text() for t in figure.axes[0].get_yticklabels()] == ["none", "SDD", "SDD + PCP"]
    for axes in figure.axes:
        assert [container.get_label() for container in axes.containers] == ["clean", "fog", "snow"]
        low, high = axes.get_xlim()
        assert low > 40 and high < 100
    np.testing.assert_allclose(figure.axes[0].containers[1].lines[0].get_xydata(), [[80, 0], [75, 1], [70, 2]])


def test_groups_of_bars_are_conditions() -> None:
    (axes,) = mean_bars(some_rows()).axes
    assert [bar.get_height() for bar in axes.containers[0]] == pytest.approx([85, 75, 65])
    assert len({round(t.get_position()[0], 3) for t in axes.texts}) == len(axes.texts) == 6
