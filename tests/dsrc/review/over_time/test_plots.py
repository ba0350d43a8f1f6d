"""Plots over frames: where a value, a level, the present and a mark are drawn."""

import math
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from dsrc.review.over_time.plots import Line, Strip, plots_svg

ROWS = np.arange(11)


def drawn(*strips: Strip, now: int = 5, marks: dict[str, int] | None = None) -> str:
    return plots_svg(strips, (0, 10), now, marks or {}, ("0.0 s", "1.0 s"))


def paths(svg: str) -> list[str]:
    return re.findall(r'<path d="([^"]*)" fill="none"', svg)


def test_a_line_goes_from_edge_to_edge_and_its_largest_value_is_at_the_top() -> None:
    (path,) = paths(drawn(Strip("speed, m/s", [Line("", (1, 2, 3), ROWS, ROWS.astype(float))])))
    x, y = np.array([[float(number) for number in pair.split()] for pair in re.findall(r"[\d.]+ [\d.]+", path)]).T
    assert (x[0], x[-1]) == (6.0, 274.0) and (np.diff(x) > 0).all() and (np.diff(y) < 0).all()
    assert y[0] - y[-1] == pytest.approx(30.0)


def test_gaps_stay_gaps_and_a_value_between_two_is_a_dot() -> None:
    values = np.array([1.0, 1.0, math.nan, 1.0, math.inf, 1.0, 1.0, 1.0, 1.0, 1.0, math.nan])
    (path,) = paths(drawn(Strip("gap, m", [Line("", (1, 2, 3), ROWS, values)])))
    assert path.count("M") == 3 and path.count("h0") == 3 and path.count("L") == 5
    assert "nan" not in path and "inf" not in path


def test_the_present_value_is_that_of_the_nearest_frame_before() -> None:
    line = Line("ego", (1, 2, 3), np.array([2, 6]), np.array([7.0, 9.0]))
    assert [line.at(row) for row in (2, 5, 6, 10)] == [7.0, 7.0, 9.0, 9.0] and math.isnan(line.at(1))
    assert "ego 7.00<" in drawn(Strip("score", [line], digits=2), now=5)
    assert "ego –<" in drawn(Strip("score", [line]), now=1)


def test_a_level_is_drawn_at_its_value() -> None:
    svg = drawn(Strip("score", [Line("", (1, 2, 3), ROWS, np.full(11, 0.2))], level=0.3, high=1.0))
    (level,) = re.findall(r'M6.0 ([\d.]+)H274.0" stroke="#5f6b7c" stroke-dasharray="5 3"', svg)
    assert float(level) == pytest.approx(18.0 + 0.7 * 30.0) and "≥ 0.3" in svg


def test_marks_that_would_cover_each_other_stand_below_each_other() -> None:
    strip = Strip("gap, m", [Line("", (1, 2, 3), ROWS, np.ones(11))])
    svg = drawn(strip, marks={"first sight": 1, "first track": 2, "contact": 9})
    height = {
        name: float(y) for y, name in re.findall(r'y="([\d.]+)" fill="#1c2430" text-anchor="middle">([^<]*)<', svg)
    }
    assert height["first sight"] == height["contact"] < height["first track"]


def test_nothing_known_draws_nothing_and_names_are_no_html() -> None:
    assert drawn(Strip("score", [Line("", (1, 2, 3), ROWS, np.full(11, math.nan))]), Strip("empty", [])) == ""
    assert "<b>" not in drawn(Strip("<b>", [Line("<b>", (1, 2, 3), ROWS, np.ones(11))]), marks={"<b>": 3})


def test_a_click_finds_the_frames_at_the_edges() -> None:
    svg = plots_svg([Strip("gap", [Line("", (1, 2, 3), ROWS, np.ones(11))])], (3, 9), 4, {}, ("", ""))
    assert 'data-ends="3,9,0.02143"' in svg


def test_the_ends_of_an_axis_are_whole_numbers_where_they_are_large_and_the_lower_one_is_told_below_zero() -> None:
    def ends(low: float, high: float) -> str:
        return drawn(Strip("points", [Line("", (1, 2, 3), ROWS, np.linspace(low, high, 11))]))

    assert ">6412<" in ends(0.0, 6412.4) and ">1.5<" in ends(0.2, 1.5) and ">-36.4 to 2.21<" in ends(-36.4, 2.21)


def test_what_is_too_long_for_a_line_goes_on_in_the_next() -> None:
    rows = np.arange(3)
    names = ("ego", "helper 1500", "helper 1510", "roadside unit 1")
    lines = [Line(name, (1, 2, 3), rows, np.full(3, 19701.0)) for name in names]
    svg = ElementTree.fromstring(plots_svg([Strip("points", lines, digits=0)], (0, 2), 1, {}, ("a", "b")))
    heads = [text for text in svg.findall("text") if text.find("tspan") is not None]
    said = [[word.text for word in text.findall("tspan")] for text in heads]
    words = ["points", *(f"{name} 19701" for name in names)]
    assert [word for line in said for word in line] == words and len(said) > 1
    assert all(6.4 * len(" ".join(line)) <= 280.0 for line in said)
    tops = [float(text.get("y")) for text in heads]
    assert tops == sorted(set(tops)) and tops[-1] < float(svg.find("rect").get("y"))
