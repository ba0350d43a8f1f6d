"""Table, plot and files of the shares of agents in detections."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from matplotlib.figure import Figure

from dsrc.evaluation.results import condition_title
from dsrc.evaluation.sharing.cells import ShareRow
from dsrc.evaluation.sharing.stored import FILE, SharedBox, SharedFrame
from dsrc.evaluation.stored import StoredDrive
from dsrc.tables.figure import COLORS, INK, WIDTH_IN, figure_style, panels, write_figure
from dsrc.tables.files import csv_text, json_text
from dsrc.tables.table import Column, Table, TableRow
from sim.files import write_file

AGENTS = ("ego", "vehicle", "roadside")
DISTANCES_M: tuple[tuple[float, float | None], ...] = ((0.0, 20.0), (20.0, 40.0), (40.0, 60.0), (60.0, None))
"""Bins of an agent's distance from a box, the last without an end."""


class Summary(NamedTuple):
    """Shares of one kind of agent at one distance.

    Attributes:
        condition: kind of the corruption, or `clean`.
        agent: one of `AGENTS`.
        low_m: least distance from the boxes.
        high_m: most distance, None without an end.
        pairs: pairs of an agent and a true box.
        share: sum of their shares.
        needed: true boxes that the team has and would not have without the agent.
        prevented: true boxes that it would have without the agent, and has not.
        made: false detections that it would not have without the agent.
        stopped: false detections of the team to which the agent's share is negative.
    """

    condition: str
    agent: str
    low_m: float
    high_m: float | None
    pairs: int
    share: float
    needed: int
    prevented: int
    made: int
    stopped: int


def summaries(rows: Sequence[ShareRow]) -> list[Summary]:
    """Shares by condition, kind of agent and distance; those without a pair are left out."""
    found = []
    for condition in dict.fromkeys(row.condition for row in rows):
        for agent in AGENTS:
            for low, high in DISTANCES_M:
                own = [row for row in rows if (row.condition, row.agent) == (condition, agent)]
                own = [row for row in own if low <= row.distance_m and (high is None or row.distance_m < high)]
                true, false = [r for r in own if r.object_id != -1], [r for r in own if r.object_id == -1]
                if not own:
                    continue
                found.append(
                    Summary(
                        condition,
                        agent,
                        low,
                        high,
                        pairs=len(true),
                        share=sum(row.share for row in true),
                        needed=sum(row.needed for row in true),
                        prevented=sum(row.prevented for row in true),
                        made=sum(row.needed for row in false),
                        stopped=sum(row.share < 0 for row in false),
                    )
                )
    return found


def share_table(rows: Sequence[ShareRow]) -> Table:
    """Table of shares by condition, kind of agent and distance."""
    columns = [Column("agent", align="left"), Column("distance", unit="m", align="left")]
    columns += [Column("true boxes"), Column("mean share")]
    columns += [Column(title) for title in ("found by it", "missed by it", "false by it")]
    lines = []
    for one in summaries(rows):
        mean = "-" if not one.pairs else f"{one.share / one.pairs:+.3f}"
        counts = (None,) * 3 if one.agent == "ego" else (one.needed, one.prevented, one.made)
        place = f"from {one.low_m:g}" if one.high_m is None else f"{one.low_m:g} to {one.high_m:g}"
        lines.append(TableRow(condition_title(one.condition), (one.agent, place, one.pairs, mean, *counts)))
    caption = "Shares of a box sum to the score with which the whole team finds it, 0 if it does not."
    return Table("shares", "Who helped", "condition", tuple(columns), tuple(lines), caption=caption, grouped=True)


def share_bars(rows: Sequence[ShareRow], frames: int) -> Figure:
    """Draw the shares per box and per frame: helpful ones upwards, harmful ones downwards, stacked by agent.

    Args:
        rows: shares.
        frames: looked at under each condition, those without any box included.
    """
    conditions = list(dict.fromkeys(row.condition for row in rows))
    with figure_style():
        figure, (true, false) = panels(WIDTH_IN, 3.2, columns=2, title="Who helped, who harmed")
        for axes, is_true in ((true, True), (false, False)):
            for side in (1, -1):
                bottom = np.zeros(len(conditions))
                for color, agent in zip(COLORS, AGENTS, strict=False):
                    heights = np.array(
                        [_per_unit(rows, c, agent, side, None if is_true else frames) for c in conditions]
                    )
                    label = agent if side > 0 and is_true and any(row.agent == agent for row in rows) else None
                    axes.bar(range(len(conditions)), heights, 0.6, bottom=bottom, color=color, label=label)
                    bottom += heights
            axes.axhline(0.0, color=INK, linewidth=0.8)
            axes.set_xticks(range(len(conditions)), [condition_title(c) for c in conditions], rotation=30, ha="right")
        true.set_title("true boxes")
        true.set_ylabel("share of score per true box")
        false.set_title("false detections")
        false.set_ylabel("share of score per frame")
        figure.legend(*true.get_legend_handles_labels(), loc="outside right upper")
    return figure


def _per_unit(rows: Sequence[ShareRow], condition: str, agent: str, side: int, frames: int | None) -> float:
    """Return the sum of an agent's helpful (1) or harmful (-1) shares per true box, or of false ones per frame."""
    here = [row for row in rows if row.condition == condition and (row.object_id == -1) == (frames is not None)]
    own = [row.share for row in here if row.agent == agent]
    boxes = {(row.drive, row.frame, row.box) for row in here}
    return sum(share for share in own if share * side > 0) / max(len(boxes) if frames is None else frames, 1)


def write_shares(
    out: Path, rows: Sequence[ShareRow], frames: int, made_by: Mapping[str, object], drives: Sequence[StoredDrive] = ()
) -> None:
    """Write `shares.csv`, a line per agent and box, `shares.json` by frame and box, and `shares.png`.

    Args:
        rows: see `dsrc.evaluation.sharing.drives.share_drives`.
        frames: see `dsrc.evaluation.sharing.drives.frames_looked_at`.
        drives: that the rows are of, for the review page.
    """
    by_frame: dict[tuple[str, str, int], dict[int, list[ShareRow]]] = {}
    for row in rows:
        by_frame.setdefault((row.drive, row.condition, row.frame), {}).setdefault(row.box, []).append(row)
    listed = [
        SharedFrame(drive, condition, frame, next(iter(boxes.values()))[0].ego_id, tuple(map(_shared, boxes.values())))
        for (drive, condition, frame), boxes in by_frame.items()
    ]
    parts = {"drives": drives, "summaries": [one._asdict() for one in summaries(rows)], "frames": listed}
    content = {"provenance": made_by, **msgspec.to_builtins(parts, str_keys=True)}
    write_file(out / FILE, json_text(content))  # the manifest first: others of an interrupted run are ours, too
    names = [field.name for field in fields(ShareRow)]
    write_file(out / "shares.csv", csv_text([asdict(row) for row in rows], names))
    write_figure(out / "shares.png", share_bars(rows, frames), made_by)


def _shared(rows: Sequence[ShareRow]) -> SharedBox:
    """Return the shares of all agents in one box."""
    one = rows[0]
    return SharedBox(
        object_id=one.object_id,
        box=(one.x_m, one.y_m, one.z_m, one.length_m, one.width_m, one.height_m, one.yaw_rad),
        team=one.team,
        share={row.agent_id: row.share for row in rows},
        without={row.agent_id: row.without for row in rows},
    )
