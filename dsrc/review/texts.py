"""Texts of live and written pages as HTML: counts, card of the selection and legend."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

from dsrc.options.review import ColorBy
from dsrc.review import palette
from dsrc.review.errors.judged import Counts
from dsrc.review.palette import Rgb
from dsrc.review.points import HEIGHT_M, RANGE_M, RETURNS
from dsrc.review.sources.moment import EpisodeMoment, EpisodeTimeline
from dsrc.review.view import OTHER_TRUTH, AgentShare, DetectionDetails, FrameView, ObjectDetails
from sensors.frame import BY_EGO, BY_HELPER, BY_NOBODY
from sensors.sweep import MOVED, SCATTERED

_SEEN_BY = {BY_EGO: "seen by the ego", BY_HELPER: "seen by helpers alone", BY_NOBODY: "seen by nobody"}


def quoted(text: str) -> str:
    """Markdown that shows a text as it is: names from files are no formatting, and no HTML."""
    return "".join(f"\\{letter}" if letter in r"\`*_{}[]<>()#|!&~" else letter for letter in " ".join(text.split()))


def plain(text: str) -> str:
    """HTML that shows a text as it is: names from files are no elements."""
    return escape(text, quote=False)


def paragraphs(*lines: str) -> str:
    """HTML of a paragraph for each line, itself HTML; those without text are left out."""
    return "".join(f'<p style="margin:.25em 1em;font-size:.88em;line-height:1.45">{line}</p>' for line in lines if line)


def _frame_report(view: FrameView) -> str:
    """HTML of a frame: number, time, true and false boxes, missed objects, precision and recall."""
    head = f"<b>Frame {view.index}</b> · {view.time_s:.1f} s"
    if not view.labelled:
        boxes = f" {view.detected} detections." if view.detected else ""
        return paragraphs(head, f"No labels: nothing is judged.{boxes}")
    if view.counts is None:
        evaluated, every = len(view.truth) - len(view.layers[OTHER_TRUTH]), len(view.truth)
        return paragraphs(head, f"{evaluated} vehicles in sight of an agent, {every} road users in all. No detector.")
    rows = [("this frame", view.counts)]
    rows += [(f"{view.seen_frames} frames", view.seen)] if view.seen_frames > 1 else []
    cells = [(name, *_counted(c), _share(c.precision), _share(c.recall)) for name, c in rows]
    return paragraphs(head) + html_table(("", "true", "false", "missed", "prec.", "recall"), cells)


def _notice(view: FrameView) -> str:
    """HTML of why detections are missing in a frame, and of the counts of the methods drawn over the judged one."""
    rows = [(one.name, *_counted(one.counts)) for one in view.compared if one.counts is not None]
    return paragraphs(plain(view.notice)) + (html_table(("over it", "true", "false", "missed"), rows) if rows else "")


def _counted(counts: Counts) -> tuple[str, str, str]:
    return str(counts.tp), str(counts.fp), str(counts.fn)


def moment_report(moment: EpisodeMoment, timeline: EpisodeTimeline, row: int, why: str = "") -> str:
    """HTML of a step of an episode: what the driver does and why, what it has heard, and how it ends.

    Args:
        why: cause of the crash, "" without one.
    """
    track = f", track {moment.decisive}" if moment.decisive >= 0 else ""
    percept = "none yet" if math.isnan(moment.percept_age_s) else f"{1e3 * moment.percept_age_s:.0f} ms old"
    links = moment.links
    ages = zip(links.senders, links.received.tolist(), (1e3 * links.age_s).tolist(), strict=True)
    told = ", ".join(f"{sender} {f'{age:.0f} ms old' if arrived else 'lost'}" for sender, arrived, age in ages)
    heard = f" · {int(links.received.sum())} of {len(links.received)} messages ({told})" if told else ""
    liars = plain(", ".join(dict.fromkeys(moment.claimed_by)))
    claims = f" · {len(moment.claims)} claims of {liars}" if liars else ""
    wanted, touched = f"<b>{moment.acceleration_mps2:+.1f} m/s²</b>", plain(moment.touched)
    hit = "" if moment.contact is None else f"<b>contact</b> with {touched} at {moment.contact.closing_mps:.1f} m/s"
    end = f"contact at {timeline.time_s[timeline.contact_row]:.1f} s" if timeline.contact_row is not None else ""
    ends = (f"outcome: {plain(timeline.outcome)}", end, plain(timeline.message))
    return paragraphs(
        f"<b>{plain(why)}</b>" if why else "",
        f"{wanted}, {plain(moment.reason)}{track} · {timeline.speed_mps[row]:.1f} m/s",
        f"percept {percept}{heard} · {len(moment.tracks)} tracks{claims}",
        hit,
        " · ".join(filter(None, ends)),
    )


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def selection_report(details: ObjectDetails | DetectionDetails | None) -> str:
    """HTML of the card of the selected object or detection."""
    if details is None:
        return paragraphs("Click a body or a detection, or choose an object.")
    return _object_card(details) if isinstance(details, ObjectDetails) else _detection_card(details)


def _object_card(details: ObjectDetails) -> str:
    change = "" if math.isnan(details.acceleration) else f", {details.acceleration:+.1f} m/s²"
    match = "" if math.isnan(details.score) else f"score {details.score:.2f}, IoU {details.iou:.2f}"
    why = ", ".join(filter(None, (f"<b>{details.verdict}</b>", plain(details.cause) or match)))
    motion = f"{details.speed:.1f} m/s{change}"
    parts = [_place(details), motion, ", ".join(details.lights), f"lane {details.lane}" if details.lane else ""]
    rows = [
        (
            one.agent,
            f"{one.points}{'' if one.points == one.points_left else f' → {one.points_left}'}",
            "" if math.isnan(one.fraction) else f"{100 * one.fraction:.0f} %",
        )
        for one in details.visibility
    ]
    visible = "visible" if any(share for *_, share in rows) else ""
    head = f"<b>{details.class_name} {details.object_id}</b>, {_SEEN_BY[details.seen_by]}"
    said = paragraphs(head, why if details.verdict else "", plain(" · ".join(filter(None, parts))))
    return said + html_table(("", "points", visible), rows) + _shares(details.shares)


def _detection_card(details: DetectionDetails) -> str:
    verdict = f", <b>{details.verdict}</b>" if details.verdict else ""
    nearest = f"IoU {details.iou:.2f} with {details.object_name}" if details.object_name else "overlaps no object"
    head = f"<b>{details.class_name}, score {details.score:.2f}</b>{verdict}"
    said = paragraphs(head, plain(details.cause), f"{nearest} · {_place(details)}")
    rows = [(agent, str(points)) for agent, points in details.points]
    return said + html_table(("", "points in the box"), rows) + _shares(details.shares)


def _place(details: ObjectDetails | DetectionDetails) -> str:
    return f"{' × '.join(f'{side:.1f}' for side in details.size)} m · {details.distance_m:.1f} m away"


def _shares(shares: Sequence[AgentShare]) -> str:
    """Table of the agents' shares, which sum to the team's score; "" without any."""
    if not shares:
        return ""
    rows = [(f"{shares[0].agent} alone", f"{shares[0].share:.2f}", "")]
    rows += [(one.agent, f"{one.share:+.2f}", f"{one.without:.2f}") for one in shares[1:]]
    return html_table(
        ("who helped", "share", "without"), [*rows, ("all", f"{sum(one.share for one in shares):.2f}", "")]
    )


def ruler_report(view: FrameView) -> str:
    """What the ruler measures: distance, heading from the ego's and time at its speed; "" without one."""
    if len(view.state.ruler) != _ENDS:
        return ""
    x, y = view.state.ruler[2] - view.state.ruler[0], view.state.ruler[3] - view.state.ruler[1]
    yaw = math.atan2(view.ego.review_from_body[1, 0], view.ego.review_from_body[0, 0])
    turn = math.degrees(math.remainder(math.atan2(y, x) - yaw, math.tau))
    side = "left" if turn > 0.0 else "right"
    gap = f", {math.hypot(x, y) / view.ego.speed:.1f} s at {view.ego.speed:.1f} m/s" if view.ego.speed > _STANDS else ""
    return f"{math.hypot(x, y):.1f} m, {abs(turn):.0f}° {side} of the ego's heading{gap}"


_ENDS = 4
"""Numbers of a whole ruler."""
_STANDS = 0.1
"""Speed up to which the ego stands, m/s."""


@dataclass(frozen=True, slots=True)
class _Row:
    """Row of the legend.

    Attributes:
        rgb: colour; None for none.
        text: what it means.
        count: how many there are, "" where that is not said.
        name: of the count, by which it is found on a page.
        boxes: whether it is of boxes, drawn by their edges.
    """

    rgb: Rgb | None
    text: str
    count: str = ""
    name: str = ""
    boxes: bool = False


def _rows(view: FrameView) -> list[_Row]:
    rows = []
    for agent in view.agents:
        lost = f", {thousands(agent.lost)} lost" if agent.lost else ""
        # Where colour tells something else the ego's body alone keeps its own.
        rgb = agent.rgb if agent.is_ego or view.state.color_by == "agent" else None
        rows.append(_Row(rgb, agent.title, f"{thousands(agent.total)} points{lost}"))
    if view.state.color_by == "fate":
        rows += [_Row(rgb, palette.FATE_NAMES[fate]) for fate, rgb in palette.FATE_COLORS.items()]
        rows.append(_Row(palette.LOST, palette.LOST_NAME))
    for number, method in enumerate(view.compared, start=1):
        text = f"{method.name}: found, false crossed, missed dashed"
        rows.append(_Row(palette.method_color(number), text, boxes=True))
    return rows + _moment_rows(view) + _box_rows(view)


def _moment_rows(view: FrameView) -> list[_Row]:
    if (moment := view.moment) is None:
        return []
    ego, made, received = view.ego.rgb, palette.FATE_COLORS[SCATTERED], moment.links.received
    shown = [
        ("tracks", True, _Row(palette.method_color(1), "track, its way in a second; thick: it decides", boxes=True)),
        ("plan", True, _Row(ego, "plan of three seconds")),
        ("links", bool(received.any()), _Row(ego, "message received")),
        ("links", not received.all(), _Row(palette.FP, "message lost, dashed")),
        ("plan", moment.contact is not None, _Row(palette.FP, "contact: the ego, thick and crossed", boxes=True)),
        ("claims", len(moment.claims) > 0, _Row(made, "claimed by a liar, crossed", boxes=True)),
        ("seen", moment.unseen is not None, _Row(palette.UNSEEN[:3], "shaded: unseen in every sweep that arrived")),
    ]
    return [row for layer, there, row in shown if there and layer not in view.state.layers_off]


def _box_rows(view: FrameView) -> list[_Row]:
    ink, others = palette.LOOKS[view.state.theme].ink, len(view.layers[OTHER_TRUTH])
    judged = view.state.color_by == "verdict"
    if view.help is not None:
        found, made = (sum(map(len, boxes)) for boxes in (view.help.found, view.help.made))
        counted = [
            (ink, "object, coloured by who helped most", found, "found"),
            (ink, "false box, crossed, by who made it", made, "made"),
            (palette.FP, "red cross: an agent lowers the score", len(view.help.harmed), "harmed"),
            (palette.FN, "missed by all, dashed", len(view.help.missed), "missed"),
        ]
    elif not view.labelled:
        counted = [(ink, "detection, not judged", view.detected, "detected")]
    elif view.counts is None:
        counted = [(ink, "object in sight of an agent", len(view.truth) - others, "objects")]
    else:
        counted = [
            (palette.TP if judged else ink, "true box", view.counts.tp, "true"),
            (palette.FP if judged else ink, "false box, crossed", view.counts.fp, "false"),
            (palette.FN if judged else ink, "missed object, dashed", view.counts.fn, "missed"),
        ]
    counted += [(palette.OTHER, "object, not evaluated", others, "other")] if others else []
    return [_Row(rgb, text, str(count), name, boxes=True) for rgb, text, count, name in counted]


def counts_line(view: FrameView) -> str:
    """HTML of a frame's number and counts in one line, for a folded legend."""
    counts = "".join(f' · <b data-count="{row.name}">{row.count}</b> {row.name}' for row in _box_rows(view))
    return f"Frame {view.index}{counts}"


def summary(view: FrameView) -> str:
    """HTML of a frame in numbers: its counts, why detections are missing, and the legend with how many there are."""
    lines = ""
    for row in _rows(view):
        color = "transparent" if row.rgb is None else palette.css(row.rgb)
        form = ("dashed" if row.text.endswith("dashed") else "solid") if row.boxes else ""
        fill = f"border:2px {form} {color};border-radius:2px" if row.boxes else f"background:{color};border-radius:50%"
        edge = ";box-shadow:none" if row.rgb is None else ""
        count = f'<b data-count="{row.name}">{row.count}</b>' if row.count else ""
        lines += f'<li><i style="{fill}{edge}"></i><span>{escape(row.text)}</span>{count}</li>'
    bar = scale_bar(view.state.color_by)
    return f'<div class="review"><style>{_STYLE}</style>{_frame_report(view)}{_notice(view)}<ul>{bar}{lines}</ul></div>'


# Below the counts; of a long legend the rest is scrolled to. A line around a mark shows white on a white panel.
_STYLE = (
    ".review ul{margin:0;padding:.2em 1em .4em;font-size:.82em;line-height:1.6;max-height:45vh;overflow:auto}"
    ".review li{display:flex;gap:.6em;align-items:baseline}"
    ".review i{flex:none;width:.7em;height:.7em;box-sizing:border-box;box-shadow:0 0 0 1px rgba(112,122,140,.6)}"
    ".review li b{margin-left:auto;font-weight:normal;text-align:right;font-variant-numeric:tabular-nums}"
)


def fates_table(view: FrameView) -> str:
    """HTML table of what the corruption did to the points of each agent."""
    rows = [
        (agent.title, *map(thousands, (agent.total, agent.fates[SCATTERED], agent.fates[MOVED], agent.lost)))
        for agent in view.agents
    ]
    return html_table(("", "points", "added", "moved", "lost"), rows)


def html_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], link: Callable[[int, int], str] = lambda *_: ""
) -> str:
    """HTML table whose first column is left-aligned, and wraps.

    Args:
        link: function from row and column to the address that a click opens, "" for none.
    """

    def cells(texts: Sequence[str], kind: str, row: int = -1) -> str:
        style = "padding:0 .5em 0 0;font-weight:normal;"
        line = ""
        for column, text in enumerate(texts):
            to = escape(link(row, column)) if row >= 0 else ""
            shown = f'<a href="{to}" style="color:inherit">{escape(text)}</a>' if to else escape(text)
            side = "white-space:nowrap;text-align:right" if column else "text-align:left"
            line += f'<{kind} style="{style}{side}">{shown}</{kind}>'
        return line

    lines = [cells(head, "th"), *(cells(row, "td", number) for number, row in enumerate(rows))]
    style = "margin:0 1.15em;font-size:.76em;line-height:1.6"
    return f'<table style="{style}">{"".join(f"<tr>{line}</tr>" for line in lines)}</table>'


def scale_bar(color_by: ColorBy) -> str:
    """HTML scale bar of the points' colours; "" where colours are no scale."""
    low, high = HEIGHT_M
    bars = {
        # Colours follow the square root: the middle of the bar is a quarter.
        "intensity": (palette.VIRIDIS, ("0", "intensity", "1"), "¼"),
        "height": (palette.TURBO, (f"{low:g} m", "above the road", f"{high:g} m"), f"{0.5 * (low + high):g} m"),
        "ring": (palette.TURBO, ("top ring", "", "lowest"), ""),
        "range": (palette.TURBO, ("0 m", "from the sensor", f"{RANGE_M:g} m"), ""),
        "time": (palette.TURBO, ("first", "in the sweep", "last"), ""),
        "return": (palette.TURBO, ("return 1", "", f"{RETURNS}"), ""),
        "incidence": (palette.TURBO, ("grazing", "cosine of incidence", "square"), ""),
    }
    if color_by not in bars:
        return ""
    table, (first, name, last), middle = bars[color_by]
    stops = ",".join(palette.css(rgb) for rgb in table[:: len(table) // 15].tolist())
    texts = (first, f"{middle} {name}".strip(), last)
    names = "".join(f"<span>{escape(text)}</span>" for text in texts)
    return (
        f'<div style="height:.7em;border-radius:3px;background:linear-gradient(to right,{stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{names}</div>'
    )


def thousands(count: int) -> str:
    """Number in groups of three digits, which stay in one line."""
    return f"{count:,}".replace(",", "\u202f")
