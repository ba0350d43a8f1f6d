"""Texts of the live page: counts, object details, legend and keys."""

import math
from collections.abc import Iterable
from html import escape

from dsrc.review import palette
from dsrc.review.palette import Rgb
from dsrc.review.view import OTHER_TRUTH, AgentView, FrameView, ObjectDetails
from sensors.frame import BY_EGO, BY_HELPER, BY_NOBODY

_SEEN_BY = {BY_EGO: "seen by the ego", BY_HELPER: "seen by a collaborator only", BY_NOBODY: "not seen"}


def frame_report(view: FrameView) -> str:
    """Markdown of a frame: number, time, TP, FP, FN, precision and recall."""
    head = f"**Frame {view.index}** · {view.time_s:.1f} s"
    if view.counts is None:
        evaluated = len(view.truth) - len(view.layers[OTHER_TRUTH])
        return f"{head}\n\n{evaluated} vehicles in sight of an agent, {len(view.truth)} road users in all."
    rows = [("this frame", view.counts), (f"{view.seen_frames} seen", view.seen)]
    table = "\n".join(
        f"| {name} | {c.tp} | {c.fp} | {c.fn} | {_share(c.precision)} | {_share(c.recall)} |" for name, c in rows
    )
    columns = "| | TP | FP | FN | prec. | recall |\n|:--|--:|--:|--:|--:|--:|"
    return f"{head}\n\n{columns}\n{table}"


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def object_report(details: ObjectDetails | None) -> str:
    """Markdown of the selected object's details."""
    if details is None:
        return "Click a body or select one."
    # In a code span a lane's underscores stay what they are.
    lane = f" · lane `{details.lane}`" if details.lane else ""
    lights = f" · {', '.join(details.lights)}" if details.lights else ""
    change = "" if math.isnan(details.acceleration) else f", {details.acceleration:+.1f} m/s²"
    head = f"**{details.class_name} {details.object_id}**, {_SEEN_BY[details.seen_by]}"
    rows = "\n".join(
        f"| {s.agent} | {s.points} | {'–' if math.isnan(s.fraction) else f'{100 * s.fraction:.0f} %'} |"
        for s in details.visibility
    )
    table = f"| | points | visible |\n|:--|--:|--:|\n{rows}"
    return f"{head}\n\n{details.speed:.1f} m/s{change}{lights}{lane}\n\n{table}"


def legend(view: FrameView) -> str:
    """HTML of the legend."""
    agents = "".join(_legend_row(agent.rgb, _title(agent)) for agent in view.agents)
    if view.color_by == "fate":
        agents += "".join(_legend_row(rgb, palette.FATE_NAMES[fate]) for fate, rgb in palette.FATE_COLORS.items())
    if view.counts is None:
        return _box(agents + _legend_row(palette.TRUTH, "ground truth", True))
    verdicts = (
        (palette.TP, "true positive"),
        (palette.FP, "false positive, crossed"),
        (palette.FN, "false negative, dashed"),
    )
    return _box(agents + "".join(_legend_row(rgb, text, True) for rgb, text in verdicts))


def _title(agent: AgentView) -> str:
    lost = f", {_thousands(agent.lost)} lost" if agent.lost else ""
    return f"{agent.title}{' · ego' if agent.is_ego else ''} · {_thousands(agent.total)} points{lost}"


def _thousands(count: int) -> str:
    return f"{count:,}".replace(",", "\u2009")


def _box(rows: str) -> str:
    return f'<div style="padding:.2em 1em .4em;font-size:.82em;line-height:1.6">{rows}</div>'


def _legend_row(rgb: Rgb, text: str, outlined: bool = False) -> str:
    color = f"rgb({rgb[0]},{rgb[1]},{rgb[2]})"
    fill = f"border:2px solid {color};border-radius:2px" if outlined else f"background:{color};border-radius:50%"
    mark = f'<span style="display:inline-block;width:.7em;height:.7em;box-sizing:border-box;{fill}"></span>'
    return f'<div style="white-space:nowrap">{mark}&nbsp; {escape(text)}</div>'


def keys_table(commands: Iterable[tuple[str, str]]) -> str:
    """Markdown table of (label, key) pairs."""
    rows = "\n".join(f"| `{key}` | {label} |" for label, key in commands)
    return f"| key | |\n|:--|:--|\n{rows}\n\nCtrl-K opens all commands."
