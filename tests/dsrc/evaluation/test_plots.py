import json

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_hex
from PIL import Image

from dsrc.detections import Detections
from dsrc.evaluation.ap import FrameResult, evaluate
from dsrc.evaluation.plots import (
    COLORS,
    corruption_bars,
    lines_of_sheet,
    png_bytes,
    precision_recall_curves,
    robustness_scatter,
    training_curves,
)
from dsrc.evaluation.rows import Row, make_row, summary_rows
from dsrc.evaluation.sheets import Column, Line, Sheet, Stat
from sim.boxes import Boxes


def some_rows(methods=("dsrc", "plain", "ego alone")):
    rows = []
    for c, condition in enumerate(("clean", "fog", "snow")):
        for m, method in enumerate(methods):
            ap = 0.9 - 0.1 * c - 0.05 * m
            rows.append(Row(method, condition, 3, 10, 40, 35, {"ap_bev_50": ap, "ap_bev_70": ap - 0.2}))
    return [*rows, *summary_rows(rows)]


def test_a_bar_per_method_condition_and_iou():
    axes = corruption_bars(some_rows()).axes[0]
    assert len(axes.patches) == 3 * 3 * 2
    heights = sorted(round(p.get_height(), 6) for p in axes.patches if to_hex(p.get_facecolor()) == COLORS[0].lower())
    assert heights == pytest.approx([0.5, 0.6, 0.7])
    assert [t.get_text() for t in axes.get_xticklabels()] == ["clean", "fog", "snow"]


def test_a_point_per_method_and_iou():
    panels = robustness_scatter(some_rows()).axes
    points = np.concatenate([c.get_offsets() for c in panels[0].collections])
    assert len(points) == 3
    np.testing.assert_allclose(points[0], [100 * 0.15 / 0.9, 80.0])


def test_curves_are_drawn_where_they_are_known():
    truth = Boxes.from_array([[0, 0, 0, 4, 2, 1.5, 0], [9, 0, 0, 4, 2, 1.5, 0]])
    result = evaluate([FrameResult(Detections(truth, np.array([0.9, 0.8], np.float32)), truth)])
    panels = precision_recall_curves([make_row("dsrc", "clean", 0, result), *some_rows(("plain",))]).axes
    assert [len(axes.lines) for axes in panels] == [2, 2]


@pytest.mark.parametrize("figure", [corruption_bars, robustness_scatter, precision_recall_curves])
@pytest.mark.parametrize("rows", [[], some_rows(("one",)), some_rows(tuple("abcdefghij"))])
def test_every_figure_can_be_saved_and_leaves_no_trace(figure, rows, tmp_path):
    before = dict(mpl.rcParams)
    path = tmp_path / "figure.png"
    path.write_bytes(png_bytes(figure(rows), {"seed": 5}, dpi=40))
    assert dict(mpl.rcParams) == before
    with Image.open(path) as image:
        assert json.loads(image.text["Description"]) == {"seed": 5}
        assert np.ptp(np.asarray(image.convert("L"))) > 100


def test_the_same_rows_give_the_same_bytes():
    first, second = (png_bytes(corruption_bars(some_rows()), dpi=40) for _ in range(2))
    assert first == second


def test_a_training_is_drawn_with_gaps_where_it_was_not_validated():
    rows = [
        {"epoch": "0", "lr": "1e-4", "train/cls": "2.0", "train/loss": "2.5", "train/reg": "0.5"},
        {
            "epoch": "1",
            "lr": "2e-4",
            "train/cls": "1.0",
            "train/loss": "1.2",
            "train/reg": "0.2",
            "val/ap_bev_50": ".6",
        },
    ]
    losses, precisions, rates = training_curves(rows).axes
    assert [line.get_label() for line in losses.lines] == ["cls", "reg"]
    np.testing.assert_allclose(precisions.lines[0].get_xydata(), [[2, 0.6]])
    np.testing.assert_allclose(rates.lines[0].get_xydata(), [[1, 1e-4], [2, 2e-4]])
    training_curves(rows[:1])


def test_curves_are_drawn_where_their_values_are_and_one_training_has_no_spread():
    lines = (
        Line("one", tuple((Stat(0.5), Stat(0.4)) for _ in range(3))),
        Line("three", tuple((Stat(0.6, 0.1), Stat(0.3, 0.1)) for _ in range(3))),
    )
    sheet = Sheet("loss", "Loss", "", "Method", tuple(map(Column, ("0", "0.1", "0.5"))), lines)
    for axes in lines_of_sheet(sheet, "share", [0, 0.1, 0.5]).axes:
        assert list(axes.get_xticks()) == [0, 0.1, 0.5]
        one, three = axes.containers
        assert list(one.lines[0].get_xdata()) == [0, 0.1, 0.5]
        assert (one.has_yerr, three.has_yerr) == (False, True)
