import json
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from dsrc.evaluation.figures.bars import corruption_bars, table_heatmap
from dsrc.evaluation.figures.curves import (
    apart,
    precision_recall_curves,
    reliability_curves,
    table_lines,
    training_curves,
)
from dsrc.evaluation.figures.points import robustness_scatter, traffic_scatter
from dsrc.evaluation.metrics.ap import FrameResult, evaluate
from dsrc.evaluation.report.tables import ap_column
from dsrc.evaluation.results import Row, make_row, summary_rows
from dsrc.ops.detections import Detections
from dsrc.tables.figure import COLORS, png_bytes, styles_of
from dsrc.tables.table import Column, Stat, Table, TableRow
from sim.boxes import Boxes


def some_rows(methods: Sequence[str] = ("dsrc", "plain", "ego alone")) -> list[Row]:
    rows = []
    for c, condition in enumerate(("clean", "fog", "snow")):
        for m, method in enumerate(methods):
            ap = 0.9 - 0.1 * c - 0.05 * m
            rows.append(Row(method, condition, 3 if c else 0, 10, 40, 35, {"ap_bev_50": ap, "ap_bev_70": ap - 0.2}))
    return [*rows, *summary_rows(rows)]


def some_sheet(
    labels: Sequence[str] = ("dsrc", "plain", "ego alone"), columns: Sequence[str] = ("clean", "fog", "snow")
) -> Table:
    values = [[(Stat(0.9 - 0.1 * c - 0.05 * m), Stat(0.7 - 0.1 * c)) for c in range(len(columns))] for m in range(9)]
    lines = tuple(TableRow(label, tuple(cells)) for label, cells in zip(labels, values, strict=False))
    return Table("x", "A title", "Method", tuple(map(ap_column, columns)), lines)


def test_a_bar_per_method_condition_and_iou() -> None:
    for axes, heights in zip(corruption_bars(some_rows()).axes, ([90, 80, 70], [70, 60, 50]), strict=True):
        assert len(axes.patches) == 3 * 3
        first = [p.get_height() for p in axes.patches if to_hex(p.get_facecolor()) == COLORS[0].lower()]
        assert first == pytest.approx(heights)
        assert [t.get_text() for t in axes.get_xticklabels()] == ["clean", "fog", "snow"]
        assert len(axes.texts) == 3 * 3 and {f"{height:.1f}" for height in heights} < {t.get_text() for t in axes.texts}


def test_a_method_has_one_style_in_all_figures() -> None:
    methods = [f"method {i}" for i in range(22)]
    styles = styles_of(methods)
    assert len(set(styles.values())) == 22
    assert len({(style.color, style.marker) for style in styles.values()}) == 22
    some = methods[15:18]
    figures = [
        corruption_bars(some_rows(some), styles=styles),
        robustness_scatter(some_rows(some), styles=styles),
        table_lines(some_sheet(some), "x", [0, 1, 2], styles),
        traffic_scatter({name: (10.0, 0.8, 0.6) for name in reversed(some)}, styles),
    ]
    for figure in figures[:2] + figures[3:]:
        for axes in figure.axes:
            for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
                color = handle.patches[0].get_facecolor() if hasattr(handle, "patches") else handle.get_color()
                assert to_hex(color) == to_hex(styles[name].color)
    for axes in figures[2].axes:
        for container in axes.containers:
            style, line = styles[container.get_label()], container.lines[0]
            assert (line.get_color(), line.get_marker(), line.get_linestyle()) == style[:3]


def test_a_map_holds_every_number_with_the_best_in_bold() -> None:
    first, second = table_heatmap(some_sheet()).axes[:2]
    assert [t.get_text() for t in first.texts] == "90.0 85.0 80.0 80.0 75.0 70.0 70.0 65.0 60.0".split()
    assert [t.get_text() for t in first.texts if t.get_fontweight() == "bold"] == ["90.0", "80.0", "70.0"]
    assert len(second.texts) == 9 and first.get_title(loc="left") == "IoU 0.5"
    assert [t.get_text() for t in first.get_yticklabels()] == ["dsrc", "plain", "ego alone"]
    lacking = Table("x", "", "", (ap_column("clean"), Column("ms", ("",))), (TableRow("a", ((Stat(np.nan),) * 2, ())),))
    assert [t.get_text() for t in table_heatmap(lacking).axes[0].texts] == ["-"]
    # Bars of many methods could not be told apart: they are numbers too.
    many = corruption_bars(some_rows(tuple("abcdefghij"))).axes[0]
    assert len(many.texts) == 30


def test_the_best_of_a_column_where_less_is_better_is_its_lowest_number_without_a_colour() -> None:
    columns = (ap_column("clean"), ap_column("mCE", better="low"), ap_column("mAP"))
    lines = [TableRow(name, ((Stat(ap),) * 2, (Stat(lost),) * 2, (Stat(ap),) * 2)) for name, ap, lost in CLEAN_AND_LOST]
    axes = table_heatmap(Table("x", "", "Method", columns, tuple(lines))).axes[0]
    assert [t.get_text() for t in axes.texts if t.get_fontweight() == "bold"] == ["90.0", "20.0", "90.0"]
    colors = [to_hex(patch.get_facecolor()) for patch in axes.patches]
    assert [color == "#ffffff" for color in colors] == [False] * 3 + [True] * 3 + [False] * 3
    assert [t.get_text() for t in axes.get_xticklabels()] == ["clean", "mCE", "mAP"]


CLEAN_AND_LOST = (("a", 0.9, 0.3), ("b", 0.8, 0.2), ("c", 0.7, 0.4))


def test_names_at_the_ends_of_lines_keep_their_distance_and_their_order() -> None:
    assert apart([0.1, 0.5, 0.9], 0.1) == [0.1, 0.5, 0.9]
    np.testing.assert_allclose(apart([0.5, 0.5, 0.52, 0.9], 0.1), [0.4067, 0.5067, 0.6067, 0.9], atol=1e-3)
    np.testing.assert_allclose(apart([0.99, 1.0], 0.1), [0.9, 1.0])
    crowd = np.array(apart(sorted(np.random.default_rng(0).uniform(0.4, 0.6, 15)), 0.06))
    assert (np.diff(crowd) > 0.06 - 1e-9).all() and crowd.min() >= 0 and crowd.max() <= 1
    figure = table_lines(some_sheet(), "s", [0, 1, 2])
    for axes in figure.axes:
        assert {t.get_text() for t in axes.texts} == {"dsrc", "plain", "ego alone"}


def test_a_point_per_method_and_iou() -> None:
    lines = robustness_scatter(some_rows()).axes[0].lines
    assert len(lines) == 3
    np.testing.assert_allclose(lines[0].get_xydata(), [[100 * 0.15 / 0.9, 80.0]])


def test_curves_are_drawn_where_they_are_known() -> None:
    truth = Boxes.from_array([[0, 0, 0, 4, 2, 1.5, 0], [9, 0, 0, 4, 2, 1.5, 0]])
    result = evaluate([FrameResult(Detections(truth, np.array([0.9, 0.8], np.float32)), truth)])
    panels = precision_recall_curves([make_row("dsrc", "clean", 0, result), *some_rows(("plain",))]).axes
    assert [len(axes.lines) for axes in panels] == [2, 2]
    (axes,) = reliability_curves([make_row("dsrc", "clean", 0, result), *some_rows(("plain",))]).axes
    assert [line.get_label() for line in axes.lines[1:]] == ["dsrc, ECE 15.0 %"]


@pytest.mark.parametrize("figure", [corruption_bars, robustness_scatter, precision_recall_curves, reliability_curves])
@pytest.mark.parametrize("rows", [[], some_rows(("one",)), some_rows(tuple("abcdefghij"))])
def test_every_figure_can_be_saved_and_leaves_no_trace(
    figure: Callable[[list[Row]], Figure], rows: list[Row], tmp_path: Path
) -> None:
    before = dict(mpl.rcParams)
    path = tmp_path / "figure.png"
    path.write_bytes(png_bytes(figure(rows), {"seed": 5}, dpi=40))
    assert dict(mpl.rcParams) == before
    with Image.open(path) as image:
        assert json.loads(image.text["Description"]) == {"seed": 5}
        assert np.ptp(np.asarray(image.convert("L"))) > 100


def test_the_same_rows_give_the_same_bytes() -> None:
    first, second = (png_bytes(corruption_bars(some_rows()), dpi=40) for _ in range(2))
    assert first == second


def test_a_training_is_drawn_with_gaps_where_it_was_not_validated() -> None:
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
    assert precisions.get_title(loc="left") == "Average precision on validation frames, %"
    assert [line.get_label() for line in losses.lines] == ["cls", "reg"]
    np.testing.assert_allclose(precisions.lines[0].get_xydata(), [[2, 60]])
    np.testing.assert_allclose(rates.lines[0].get_xydata(), [[1, 1e-4], [2, 2e-4]])
    seen = [{name.replace("val/", "train/"): value for name, value in row.items()} for row in rows]
    losses, precisions, _ = training_curves(seen).axes
    assert precisions.get_title(loc="left") == "Average precision on training frames, %"
    assert [line.get_label() for line in losses.lines] == ["cls", "reg"]
    np.testing.assert_allclose(precisions.lines[0].get_xydata(), [[2, 60]])
    figure = training_curves(rows[:1], "a run")
    png_bytes(figure, dpi=40)
    for axes in figure.axes:
        assert all(float(tick).is_integer() for tick in axes.get_xticks())
    assert figure.get_suptitle() == "a run"


def test_curves_are_drawn_where_their_values_are_and_one_training_has_no_spread() -> None:
    lines = (
        TableRow("one", tuple((Stat(0.5), Stat(0.4)) for _ in range(3))),
        TableRow("three", tuple((Stat(0.6, 0.1), Stat(0.3, 0.1)) for _ in range(3))),
    )
    sheet = Table("loss", "Loss", "Method", tuple(map(ap_column, ("0", "0.1", "0.5"))), lines)
    for axes in table_lines(sheet, "share", [0, 0.1, 0.5]).axes:
        assert list(axes.get_xticks()) == [0, 0.1, 0.5]
        one, three = axes.containers
        assert list(one.lines[0].get_xdata()) == [0, 0.1, 0.5]
        assert (one.has_yerr, three.has_yerr) == (False, True)
