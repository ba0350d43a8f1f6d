"""The texts of the live page: counts, legend and keys."""

import math
from collections.abc import Iterable
from html import escape

from dsrc.review import palette
from dsrc.review.palette import Rgb
from dsrc.review.view import OTHER_BOXES, AgentView, FrameView, ObjectFacts
from sensors.frame import BY_EGO, BY_HELPER, BY_NOBODY

_SEEN_BY = {BY_EGO: "seen by the ego", BY_HELPER: "seen by a helper only", BY_NOBODY: "seen by nobody"}


def report(view: FrameView) -> str:
    """Return the markdown of a frame: when it is, and how well it was seen."""
    head = f"**Frame {view.index}** · {view.time_s:.1f} s"
    if view.counts is None:
        judged = len(view.truth) - len(view.layers[OTHER_BOXES])
        return f"{head}\n\n{judged} vehicles in sight of an agent, {len(view.truth)} road users in all."
    rows = [("this frame", view.counts), (f"{view.seen_frames} seen", view.seen)]
    table = "\n".join(
        f"| {name} | {c.right} | {c.wrong} | {c.missed} | {_share(c.precision)} | {_share(c.recall)} |"
        for name, c in rows
    )
    columns = "| | TP | FP | FN | prec. | recall |\n|:--|--:|--:|--:|--:|--:|"
    return f"{head}\n\n{columns}\n{table}"


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def object_report(facts: ObjectFacts | None) -> str:
    """Return the markdown of what is known of the chosen object."""
    if facts is None:
        return "Click a body or choose one."
    # In a code span a lane's underscores stay what they are.
    lane = f" · lane `{facts.lane}`" if facts.lane else ""
    lights = f" · {', '.join(facts.lights)}" if facts.lights else ""
    change = "" if math.isnan(facts.acceleration) else f", {facts.acceleration:+.1f} m/s²"
    head = f"**{facts.class_name} {facts.object_id}**, {_SEEN_BY[facts.seen_by]}"
    rows = "\n".join(
        f"| {s.agent} | {s.points} | {'–' if math.isnan(s.fraction) else f'{100 * s.fraction:.0f} %'} |"
        for s in facts.sightings
    )
    table = f"| | points | visible |\n|:--|--:|--:|\n{rows}"
    return f"{head}\n\n{facts.speed:.1f} m/s{change}{lights}{lane}\n\n{table}"


def legend(view: FrameView) -> str:
    """Return the HTML that says which colour is whose."""
    agents = "".join(_entry(agent.rgb, _title(agent)) for agent in view.agents)
    if view.color_by == "fate":
        agents += "".join(_entry(rgb, palette.FATE_NAMES[fate]) for fate, rgb in palette.FATE_COLORS.items())
    if view.counts is None:
        return _box(agents + _entry(palette.TRUTH, "ground truth", True))
    verdicts = (
        (palette.RIGHT, "right (TP)"),
        (palette.WRONG, "wrong (FP), crossed"),
        (palette.MISSED, "missed (FN), dashed"),
    )
    return _box(agents + "".join(_entry(rgb, text, True) for rgb, text in verdicts))


def _title(agent: AgentView) -> str:
    lost = f", {_thousands(agent.lost)} lost" if agent.lost else ""
    return f"{agent.title}{' · ego' if agent.is_ego else ''} · {_thousands(agent.total)} points{lost}"


def _thousands(count: int) -> str:
    return f"{count:,}".replace(",", "\u2009")


def _box(rows: str) -> str:
    return f'<div style="padding:.2em 1em .4em;font-size:.82em;line-height:1.6">{rows}</div>'


def _entry(rgb: Rgb, text: str, outlined: bool = False) -> str:
    color = f"rgb({rgb[0]},{rgb[1]},{rgb[2]})"
    fill = f"border:2px solid {color};border-radius:2px" if outlined else f"background:{color};border-radius:50%"
    mark = f'<span style="display:inline-block;width:.7em;height:.7em;box-sizing:border-box;{fill}"></span>'
    return f'<div style="white-space:nowrap">{mark}&nbsp; {escape(text)}</div>'


def keys_table(commands: Iterable[tuple[str, str]]) -> str:
    """Return the markdown table of (label, key)."""
    rows = "\n".join(f"| `{key}` | {label} |" for label, key in commands)
    return f"| key | |\n|:--|:--|\n{rows}\n\nCtrl-K opens all commands."
