"""Figures of a campaign show the rates of their results, and leave out what lost its encounter."""

import math
from dataclasses import dataclass, field
from typing import Any

import pytest
from matplotlib.figure import Figure

from dsrc.closed_loop.report.plots import (
    collision_and_score,
    cost_of_channel,
    deadly_corruptions,
    rate_over_severity,
)
from dsrc.tables.figure import png_bytes


@dataclass(frozen=True)
class One:
    perception: str
    corruption: str = "clean"
    severity: int = 0
    seed: int = 0
    scenario: str = "ima"
    who: str = "all"
    channel: str = "ideal"
    fault: str = ""
    defence: str = ""
    outcome: str = "arrived"
    metrics: dict[str, float | None] = field(default_factory=dict)


def cell(perception: str, crashes: int, episodes: int = 10, **where: Any) -> list[One]:
    return [
        One(perception, seed=seed, metrics={"collision": float(seed < crashes), "driving_score_2_1": 0.5}, **where)
        for seed in range(episodes)
    ]


LOST = One("ego", "fog", 3, seed=99, outcome="desynchronised", metrics={"collision": 1.0})
RESULTS = [
    *cell("truth", 0),
    *cell("ego", 2),
    *cell("ego", 9, corruption="fog", severity=3),
    *cell("ego", 2, corruption="snow", severity=3),
    LOST,
]


def points(figure: Figure, panel: int, name: str) -> list[tuple[float, float]]:
    """Heights and interval widths of a perception in a panel, percent, from left to right."""
    for bars in figure.axes[panel].containers:
        if bars.get_label() == name:
            heights = bars.lines[0].get_ydata().tolist()
            widths = [path.vertices[1, 1] - path.vertices[0, 1] for path in bars.lines[2][0].get_paths()]
            return list(zip(heights, widths, strict=True))
    raise AssertionError(name)


def test_collision_rates_have_wilson_intervals_and_scores_those_of_the_bootstrap() -> None:
    figure = collision_and_score(RESULTS)
    rates = points(figure, 0, "ego")
    assert [height for height, _ in rates] == pytest.approx([20.0, 90.0, 20.0])
    # Wilson, 2 of 10: 5.67 % to 50.98 %.
    assert rates[0][1] == pytest.approx(50.98 - 5.67, abs=0.02)
    assert points(figure, 1, "ego") == [(50.0, 0.0)] * 3
    assert points(figure, 0, "truth")[0][0] == 0.0
    assert [tick.get_text() for tick in figure.axes[0].get_xticklabels()] == ["clean", "fog", "snow"]


def test_faults_are_groups_of_their_own_after_the_corruptions() -> None:
    faults = [
        *cell("ego", 5, channel="ideal,loss=0.3"),
        *cell("ego", 8, fault="fog:3 from 2 s + bursts:0.3"),
    ]
    figure = collision_and_score([*faults, *RESULTS])
    assert [height for height, _ in points(figure, 0, "ego")] == pytest.approx([20.0, 90.0, 20.0, 50.0, 80.0])
    titles = [tick.get_text().replace("\n", " ").replace("\u00a0", " ") for tick in figure.axes[0].get_xticklabels()]
    assert titles == ["clean", "fog", "snow", "ideal,loss=0.3", "fog:3 from 2 s + bursts:0.3"]


def test_curves_over_severity_begin_at_clean() -> None:
    figure = rate_over_severity([*RESULTS, *cell("ego", 4, corruption="fog", severity=1)])
    assert [height for height, _ in points(figure, 0, "ego")] == pytest.approx([20.0, 40.0, 90.0])
    assert figure.axes[0].get_title(loc="left") == "fog"


def test_the_heat_map_says_how_many_more_crash_than_clean_and_which_are_sure() -> None:
    """Seven of ten pairs crash in fog alone: p = 2 / 2^7 = 0.016."""
    figure = deadly_corruptions(RESULTS)
    texts = {text.get_text(): text.get_fontweight() for text in figure.axes[0].texts}
    assert texts == {"+70": "bold", "0": "normal"}
    assert figure.axes[0].get_title(loc="left") == "ego"


def test_the_cost_of_a_channel_is_drawn_at_its_quantity() -> None:
    swept = [one for share in (0, 5) for one in cell("team", share, channel=f"loss {share}")]
    figure = cost_of_channel(
        [*swept, *cell("team", 3, channel="other")],
        {"lost, tenths": lambda one: float(one.channel[5:]) if one.channel[:4] == "loss" else math.nan},
    )
    assert [height for height, _ in points(figure, 0, "team")] == pytest.approx([0.0, 50.0])
    assert figure.axes[0].get_xticks().tolist() == [0.0, 5.0]


def test_a_figure_is_the_same_bytes_each_time_and_empty_results_are_no_error() -> None:
    assert png_bytes(collision_and_score(RESULTS)) == png_bytes(collision_and_score(RESULTS))
    for draw in (collision_and_score, rate_over_severity, deadly_corruptions):
        assert png_bytes(draw([]))[:4] == b"\x89PNG"
