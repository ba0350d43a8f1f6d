"""Plots over time: of a selected object, and of an episode."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dsrc.review import palette
from dsrc.review.errors.judged import JudgedRun
from dsrc.review.errors.judgements import Judgements
from dsrc.review.over_time.plots import Line, Strip, plots_svg
from dsrc.review.sources.history import Seen
from dsrc.review.sources.moment import EpisodeTimeline
from dsrc.review.state import ReviewState
from dsrc.review.view import FrameView

if TYPE_CHECKING:
    # The closed loop takes a second to import.
    from dsrc.review.sources.meeting import Meeting

_NAMED = 4
"""Agents up to which plots say whose number is whose; the legend has their colours."""


def over_time(model: Judgements, state: ReviewState, view: FrameView) -> str:
    """SVG of the plots of an episode and of the selected object, "" where there is nothing to plot."""
    first, last, line = model.first_row(state.drive), model.frame_count(state.drive) - 1, model.timeline(state.drive)
    if last < 1:
        return ""
    strips: list[Strip] = []
    marks: dict[str, int] = {}
    edges = f"frame {first}", f"{last}"
    if line is not None:
        met = model.meeting(state.drive)
        strips, marks = episode_strips(line, met), {} if met is None else met.marks
        edges = f"{line.time_s[0]:.1f} s", f"{line.time_s[-1]:.1f} s"
    if (object_id := getattr(view.details, "object_id", None)) is not None:
        seen = model.histories[state.drive].of(object_id, view.ego.agent_id)
        method = model.method(state)
        run = model.run(state.drive, method, model.setup(state)) if method and view.labelled else None
        strips += object_strips(seen, run, object_id, state, view)
    return plots_svg(strips, (first, last), state.frame, marks, edges)


def episode_strips(line: EpisodeTimeline, met: "Meeting | None") -> list[Strip]:
    """Speed, acceleration, and gap and time to collision with whom the ego meets, step by step."""
    rows = np.arange(len(line.time_s))
    blue, amber = palette.AGENT_COLORS[0], palette.FN
    strips = [
        Strip("speed, m/s", [Line("", blue, rows, line.speed_mps)]),
        Strip(
            "m/s²",
            [Line("wanted", amber, rows, line.wanted_mps2), Line("real", blue, rows, line.acceleration_mps2)],
        ),
    ]
    if met is not None:
        strips += [
            Strip("gap, m", [Line("", palette.OTHER, rows, met.gap_m)]),
            Strip("time to collision, s", [Line("", palette.OTHER, rows, met.ttc_s)]),
        ]
    return strips


def object_strips(
    seen: Seen, run: JudgedRun | None, object_id: int, state: ReviewState, view: FrameView
) -> list[Strip]:
    """Score, IoU, points, visibility and distance of an object over the frames that are known.

    Args:
        seen: of the object.
        run: judged detections of the shown method; None without any.
        view: whose agents have the colours.
    """
    strips = [] if run is None else _judged(run, object_id, state)
    shown = {agent.agent_id: agent for agent in view.agents}
    named = len([one for one in seen.points if one in shown]) <= _NAMED

    def lines(values: dict[int, NDArray[np.float64]], scale: float = 1.0) -> list[Line]:
        return [
            Line(("ego" if agent.is_ego else str(one)) if named else "", agent.rgb, seen.rows, scale * values[one])
            for one, agent in shown.items()
            if one in values and one != object_id
        ]

    points = lines(seen.points)
    if run is not None and (left := _left(run, object_id)) is not None:
        points.append(left)
    strips += [
        Strip("points", points, digits=0),
        Strip("visible, %", lines(seen.visible, 100.0), high=100.0, digits=0),
        Strip("distance, m", [Line("", palette.OTHER, seen.rows, seen.distance_m)]),
    ]
    return [strip for strip in strips if strip.lines]


def _judged(run: JudgedRun, object_id: int, state: ReviewState) -> list[Strip]:
    own = np.flatnonzero(run.table.object_id == object_id)
    rows = run.table.position[run.truth_frame_of[own]]
    by = run.at(state.iou).found_by[own]
    score = np.where(by >= 0, np.append(run.table.score, 0.0)[by], np.nan).astype(np.float64)
    iou = np.where(run.best_iou[own] > 0.0, run.best_iou[own], np.nan)
    return [
        Strip("score", [Line("", palette.TP, rows, score)], state.threshold, 1.0, 2),
        Strip("IoU", [Line("", palette.TP, rows, iou)], state.iou, 1.0, 2),
    ]


def _left(run: JudgedRun, object_id: int) -> Line | None:
    """Points of all agents that a corruption leaves; None where it takes none, or that is unknown."""
    own = np.flatnonzero(run.table.object_id == object_id)
    before, after = run.table.points[own, 1], run.table.points[own, 3]
    if not ((after >= 0) & (after < before)).any():
        return None
    left = np.where(after >= 0, after, np.nan).astype(np.float64)
    return Line("left", palette.OTHER, run.table.position[run.truth_frame_of[own]], left, dashed=True)
