"""Plots over time: of a selected object or box, and of an episode."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dsrc.ops.iou import bev_iou
from dsrc.review import palette
from dsrc.review.errors.judged import JudgedRun
from dsrc.review.errors.judgements import Judgements
from dsrc.review.over_time.plots import Line, Strip, plots_svg
from dsrc.review.sources.history import Seen
from dsrc.review.sources.moment import EpisodeTimeline
from dsrc.review.state import ReviewState
from dsrc.review.view import DetectionDetails, FrameView
from sim.boxes import Boxes

if TYPE_CHECKING:
    # The closed loop takes a second to import.
    from dsrc.review.sources.meeting import Meeting

_NAMED = 4
"""Agents up to which plots say whose number is whose; the legend has their colours."""

_ABSENT = 10
"""Frames without an overlapping box after which a followed one has ended."""


def over_time(model: Judgements, state: ReviewState, view: FrameView) -> str:
    """SVG of the plots of an episode and of the selected object, "" where there is nothing to plot."""
    source = model.sources[state.drive]
    first, last, line = source.first, len(source) - 1, source.timeline()
    if last < 1:
        return ""
    strips: list[Strip] = []
    marks: dict[str, int] = {}
    edges = f"frame {first}", f"{last}"
    if line is not None:
        met = source.meeting
        strips, marks = episode_strips(line, met), {} if met is None else met.marks
        edges = f"{line.time_s[0]:.1f} s", f"{line.time_s[-1]:.1f} s"
    details, history, method = view.details, model.histories[state.drive], model.method(state)
    run = model.run(state.drive, method, model.setup(state)) if details is not None and method else None
    if isinstance(details, DetectionDetails) and details.verdict != "true" and run is not None:
        strips += box_strips(run, history.lidars(view.ego.agent_id), details.rank, state)
    elif details is not None and details.object_id is not None:
        seen = history.of(details.object_id, view.ego.agent_id)
        strips += object_strips(seen, run if view.labelled else None, details.object_id, state, view)
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
            Line(agent.title if named else "", agent.rgb, seen.rows, scale * values[one])
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


def box_strips(run: JudgedRun, lidars: Mapping[int, NDArray[np.float64]], rank: int, state: ReviewState) -> list[Strip]:
    """Score, IoU with the nearest object and distance of a box of nothing, followed over the frames.

    Args:
        run: detections of the shown method.
        lidars: (4, 4) world poses of the ego's LiDAR by row.
        rank: place of the box in the order of the scores of the state's frame.
    """
    rows = _followed(run, lidars, state.frame, rank)
    at, score = run.table.position[run.frame_of[rows]], run.table.score[rows].astype(np.float64)
    return [
        Strip("score of this box", [Line("", palette.FP, at, score)], state.threshold, 1.0, 2),
        Strip("IoU with an object", [Line("", palette.FP, at, run.nearest_iou[rows])], state.iou, 1.0, 2),
        Strip("distance, m", [Line("", palette.OTHER, at, run.distance_m[rows])]),
    ]


def _followed(run: JudgedRun, lidars: Mapping[int, NDArray[np.float64]], frame: int, rank: int) -> NDArray[np.int64]:
    """(K,) rows of the detections that overlap the last one found, to both sides of a frame, ascending.

    A box that is absent for `_ABSENT` frames has ended.
    """
    first = np.flatnonzero((run.table.position[run.frame_of] == frame) & (run.rank == rank))
    if frame not in lidars or not len(first):
        return first
    found = first.tolist()
    known = sorted(set(run.table.position.tolist()) & set(lidars))
    at = known.index(frame)

    def in_world(rows: NDArray[np.int64], row: int) -> NDArray[np.float64]:
        return Boxes.from_array(run.table.boxes[rows].astype(np.float64)).transform(lidars[row]).array

    for ahead in (known[at + 1 :], known[:at][::-1]):
        last, absent = in_world(first, frame), 0
        for row in ahead:
            here = np.flatnonzero(run.table.position[run.frame_of] == row)
            boxes = in_world(here, row)
            overlap = bev_iou(last, boxes).ravel()
            if overlap.any():
                best = int(overlap.argmax())
                last, absent = boxes[best : best + 1], 0
                found.append(int(here[best]))
            elif (absent := absent + 1) == _ABSENT:
                break
    return np.sort(np.array(found, np.int64))


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
