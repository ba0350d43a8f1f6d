"""Gallery: errors as small bird's-eye pictures, grouped by their cause."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from html import escape

import numpy as np
from numpy.typing import NDArray

from dsrc.review import palette
from dsrc.review.errors.filters import FP, POOR
from dsrc.review.errors.index import ErrorTable
from dsrc.review.errors.judgements import Judgements
from dsrc.review.errors.report import selection_of
from dsrc.review.state import ReviewState
from sensors.frame import Frame
from sim.boxes import Boxes
from sim.errors import UserError
from sim.geometry import invert, transform_points

MOST = 24
"""Pictures of a gallery: the worst errors."""
_HALF_M = 11.0
"""Half the width of a picture, m."""
_POINTS = 160
"""Most points of a kind in a picture."""
_GROUND_M = 0.35
"""Height above an object's underside below which points are ground, m."""


@dataclass(frozen=True, slots=True)
class Picture:
    """Picture of an error: its cause, a sentence and a bird's-eye view as SVG, and the state that shows it."""

    kind: str
    sentence: str
    svg: str
    opens: ReviewState


def pictures_of(model: Judgements, state: ReviewState, errors: ErrorTable) -> Iterator[Picture]:
    """Make pictures of the worst errors that a state lists, one by one."""
    for row in [row for row in range(len(errors)) if errors.kind[row] != POOR][:MOST]:
        at = replace(state, methods=(errors.methods[errors.method[row]],), **selection_of(errors, row))
        key = (at.drive, at.frame, at.object_id, at.detection, at.methods, model.setup(at), at.threshold, at.iou)
        try:
            kind, sentence, svg = model.drawn.get(key, partial(_picture, model, at, errors, row))
        except UserError as error:
            kind, sentence, svg = "not read", str(error), ""
        if kind:
            yield Picture(kind, sentence, svg, at)


def _picture(model: Judgements, at: ReviewState, errors: ErrorTable, row: int) -> tuple[str, str, str]:
    """Kind, sentence and SVG of an error, empty where its frame has no such error, as one of another run."""
    own = model.cause(at)
    if own is None:
        return "", "", ""
    frames = model.stores[at.drive].recorded(at.frame), model.frame(at)
    return f"{own.error}: {own.kind}", own.sentence, _drawn(*frames, errors, row, own.hidden_from)


def _drawn(clean: Frame, shown: Frame, errors: ErrorTable, row: int, hidden_from: tuple[int, ...]) -> str:
    """SVG of the surroundings of an error: points before and after, the box, road users, and who looks at it."""
    ego = int(errors.ego_id[row])
    lidar = clean.agent(ego).sweep.world_from_lidar
    back, box = invert(lidar), Boxes.from_array(errors.box[row : row + 1].astype(np.float64))
    middle, floor = box.center[0, :2], float(box.center[0, 2] - 0.5 * box.size[0, 2]) + _GROUND_M
    parts = []
    for frame, rgb, faded in ((clean, (178, 184, 191), 0.8), (shown, palette.LOOKS["light"].ink, 1.0)):
        clouds = [transform_points(back @ one.sweep.world_from_lidar, one.sweep.points[:, :3]) for one in frame.agents]
        points = np.concatenate(clouds)
        near = (np.abs(points[:, :2] - middle) <= _HALF_M).all(axis=1) & (points[:, 2] > floor)
        parts.append(_points(points[near, :2] - middle, rgb, faded))
    truth = clean.truth.transform(back)
    around = np.abs(truth.center[:, :2] - middle).max(axis=1, initial=0.0) <= 2.0 * _HALF_M
    parts += [_outline(one - middle, palette.OTHER, "") for one in truth[around].bev_polygons()]
    false = errors.kind[row] == FP
    (corners,) = box.bev_polygons()
    parts.append(_outline(corners - middle, palette.FP if false else palette.FN, "" if false else "1.2 .8", 0.5))
    if not false:
        for number, agent in enumerate(clean.agents):
            if agent.agent_id != errors.object_id[row]:
                place = (back @ agent.sweep.world_from_lidar)[:2, 3] - middle
                dash = "1 1" if agent.agent_id in hidden_from else ""
                parts.append(_outline(np.stack([place, [0.0, 0.0]]), palette.agent_color(number), dash))
    h = _HALF_M
    size = f'viewBox="{-h:g} {-h:g} {2 * h:g} {2 * h:g}" width="100%" style="background:#eef1f3;border-radius:4px"'
    return f"<svg {size}>{''.join(parts)}</svg>"


def _points(places: NDArray[np.float64], rgb: palette.Rgb, opacity: float) -> str:
    some = places[:: max(len(places) // _POINTS, 1)][:_POINTS]
    path = "".join(f"M{x:.1f} {-y:.1f}h0" for x, y in some)
    style = f'stroke="{palette.css(rgb)}" stroke-width=".32" stroke-linecap="round" opacity="{opacity:g}"'
    return f'<path d="{path}" {style}/>'


def _outline(places: NDArray[np.float64], rgb: palette.Rgb, dash: str, width: float = 0.22) -> str:
    path = "L".join(f"{x:.1f} {-y:.1f}" for x, y in places)
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    closed, style = "Z" if len(places) > 2 else "", f'stroke="{palette.css(rgb)}" stroke-width="{width}"{dashes}'
    return f'<path d="M{path}{closed}" fill="none" {style}/>'


def gallery_html(pictures: Sequence[Picture], links: Sequence[str]) -> str:
    """HTML of pictures by cause, the most frequent first.

    Args:
        links: addresses that a click on each of them opens, "" for none.
    """
    groups: dict[str, list[int]] = {}
    for number, one in enumerate(pictures):
        groups.setdefault(one.kind, []).append(number)
    parts = []
    goes = [f' href="{escape(link)}"' if link else "" for link in links]
    for kind, numbers in sorted(groups.items(), key=lambda group: -len(group[1])):
        cells = "".join(
            f'<a{goes[number]} title="{escape(pictures[number].sentence)}" '
            f'style="color:inherit;text-decoration:none">{pictures[number].svg}'
            f'<div style="font-size:.75em;line-height:1.25">{escape(pictures[number].sentence)}</div></a>'
            for number in numbers
        )
        grid = "display:grid;grid-template-columns:1fr 1fr;gap:.5em;margin:.3em 0 .7em"
        parts.append(f'<b style="font-size:.85em">{escape(kind)} · {len(numbers)}</b><div style="{grid}">{cells}</div>')
    return f'<div style="margin:0 .8em">{"".join(parts)}</div>'
