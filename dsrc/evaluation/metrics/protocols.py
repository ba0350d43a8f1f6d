"""Protocols: what a published average precision counts, one struct each.

Matches, orders and recalls are those of `dsrc.evaluation.metrics.ap`; a protocol says which of them it takes and which
boxes count. `Curve.ap_opencood` is `testbed-per-frame` and `Curve.ap` is `testbed`, over boxes already chosen.
"""

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import OPENCOOD_RANGE_M, Range
from dsrc.evaluation.metrics.ap import MatchedBy, Order, Recalls, Space
from dsrc.evaluation.metrics.kitti import LEAST_PX, LEVELS, MOST_OCCLUDED, MOST_TRUNCATED, Level
from sim.boxes import Boxes
from sim.errors import SettingsError, complaint, did_you_mean

ALL = "all"


class Protocol(msgspec.Struct, frozen=True, kw_only=True):
    """Protocol of an average precision.

    Attributes:
        name: unique.
        source: where it is published.
        range_m: range of the boxes in the ego LiDAR's frame, m; None for those that are given.
        corners: least number of a box's eight corners in that range, of true and of detected boxes.
        reach_m: greatest distance from the ego of an agent whose objects count, m.
        ego: the ego's own box is one of the true boxes.
        order: of the detections.
        recalls: of the area.
        matched_by: who chooses.
        spaces: overlap in bird's-eye view, of volumes, or both.
        level: KITTI's level of difficulty, see `dsrc.evaluation.metrics.kitti`; None for none.
        unlike: what differs from the source, one clause; "" for nothing.
    """

    name: str
    source: str
    range_m: Range | None = None
    corners: int = 8
    reach_m: float = 70.0
    ego: bool = False
    order: Order = "global"
    recalls: Recalls = "all"
    matched_by: MatchedBy = "detections"
    spaces: tuple[Space, ...] = ("bev",)
    level: Level | None = None
    unlike: str = ""

    @property
    def card(self) -> str:
        """What is counted, in one line."""
        if self.level is not None:
            row = LEVELS.index(self.level)
            parts = [
                f"cars above {LEAST_PX[row]} px in the image, occlusion to {MOST_OCCLUDED[row]}"
                f", truncation to {MOST_TRUNCATED[row]:g}",
                "other cars and vans count neither way",
                "true boxes choose",
                _RECALLS[self.recalls],
            ]
            return ", ".join(parts)
        parts = ["all boxes given"]
        if self.range_m is not None:
            how = "whole boxes" if self.corners == 8 else f"boxes with {self.corners} of 8 corners"
            parts = [f"{how} in {_words(self.range_m)}"]
        if math.isfinite(self.reach_m):
            parts.append(f"agents within {self.reach_m:g} m")
        parts.append("with the ego" if self.ego else "without the ego")
        parts.append("sorted per frame" if self.order == "frame" else "sorted over all frames")
        if self.matched_by == "truth":
            parts.append("true boxes choose")
        parts.append(_RECALLS[self.recalls])
        return ", ".join(parts) + (f"; unlike the source, {self.unlike}" if self.unlike else "")

    def counts(self, boxes: Boxes) -> NDArray[np.bool_]:
        """(N,) boxes in its range, by corners in single precision.

        So do the published loaders (`check_numpy_to_torch` of OpenCOOD's common_utils.py): a truck of 2.9 m under a
        LiDAR at 1.9 m, which ends at z = 1.0 give or take the rounding of a pose, is in OpenCOOD's range.
        """
        if self.range_m is None:
            return np.ones(len(boxes), bool)
        corners = _single_corners(boxes)
        low, high = np.array(self.range_m[:3]), np.array(self.range_m[3:])
        within: NDArray[np.bool_] = ((corners >= low) & (corners <= high)).all(axis=2).sum(axis=1) >= self.corners
        return within


def _single_corners(boxes: Boxes) -> NDArray[np.float32]:
    """Return (N, 8, 3) corners of boxes, each step in float32."""
    center, size, yaw = (values.astype(np.float32) for values in (boxes.center, boxes.size, boxes.yaw))
    length, width, height = (_HALVES * size[:, None, :]).transpose(2, 0, 1)
    cosine, sine = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    corners = np.stack([cosine * length - sine * width, sine * length + cosine * width, height], axis=2)
    return np.asarray(corners + center[:, None, :], np.float32)


_HALVES = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)], np.float32)
_RECALLS: dict[Recalls, str] = {
    "all": "all recalls",
    "all-but-first": "recalls from the first detection's on",
    "11": "11 recalls",
    "40": "40 recalls",
}


def _words(range_m: Range) -> str:
    spans = [
        f"±{high:g}" if low == -high else f"{low:g} to {high:g}"
        for low, high in zip(range_m[:3], range_m[3:], strict=True)
    ]
    return f"x {spans[0]}, y {spans[1]}, z {spans[2]} m"


_OPENCOOD = "R. Xu et al., OPV2V, ICRA 2022; OpenCOOD, eval_utils.py and GT_RANGE, also V2X-ViT's and DSRC's"
_SORTED = "OpenCOOD with --global_sort_detections"
_EGO = "; the ego's own box left out, see OpenCOOD issue 141"
_COALIGN = "Y. Lu et al., CoAlign, ICRA 2023; its eval_utils.py and gt_range of "
_DEVKIT = "A. Geiger et al., CVPR 2012, and KITTI's object development kit"
_KITTI: dict[Recalls, str] = {"11": _DEVKIT, "40": f"{_DEVKIT}; A. Simonelli et al., ICCV 2019"}
_NO_LEVELS = "vehicles of every class and difficulty, and the best detection chooses"
_BOTH: tuple[Space, ...] = ("bev", "3d")

_TABLE = (
    Protocol(name="opencood", range_m=OPENCOOD_RANGE_M, ego=True, order="frame", source=_OPENCOOD),
    Protocol(name="opencood-global", range_m=OPENCOOD_RANGE_M, ego=True, source=_SORTED),
    Protocol(name="opencood-no-ego", range_m=OPENCOOD_RANGE_M, order="frame", source=_OPENCOOD + _EGO),
    Protocol(name="opencood-global-no-ego", range_m=OPENCOOD_RANGE_M, source=_SORTED + _EGO),
    Protocol(
        name="v2v4real",
        range_m=(-100.0, -40.0, -5.0, 100.0, 40.0, 3.0),
        ego=True,
        order="frame",
        source="R. Xu et al., V2V4Real, CVPR 2023; its eval_utils.py and GT_RANGE",
    ),
    Protocol(
        name="coalign", range_m=(-140.8, -40.0, -3.0, 140.8, 40.0, 1.0), ego=True, source=_COALIGN + "OPV2V, CoAlign"
    ),
    Protocol(
        name="coalign-v2x-vit",
        range_m=(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0),
        ego=True,
        source=_COALIGN + "OPV2V, V2X-ViT",
    ),
    Protocol(
        name="coalign-dair",
        range_m=(-100.8, -40.0, -3.5, 100.8, 40.0, 1.5),
        reach_m=100.0,
        ego=True,
        source=_COALIGN + "DAIR-V2X",
    ),
    Protocol(
        name="dair-vic",
        range_m=(0.0, -39.68, -3.0, 100.0, 39.68, 1.0),
        corners=1,
        reach_m=math.inf,
        recalls="all-but-first",
        matched_by="truth",
        spaces=_BOTH,
        source="H. Yu et al., DAIR-V2X, CVPR 2022; its eval_utils.py, filter_utils.py and --extended-range",
    ),
    *(
        Protocol(
            name=f"kitti-r{recalls}", reach_m=math.inf, recalls=recalls, spaces=_BOTH, source=source, unlike=_NO_LEVELS
        )
        for recalls, source in _KITTI.items()
    ),
    *(
        Protocol(name=f"kitti-{level}-r{recalls}", level=level, recalls=recalls, spaces=_BOTH, source=source)
        for recalls, source in _KITTI.items()
        for level in LEVELS
    ),
    Protocol(name="testbed", spaces=_BOTH, source="`ap` of dsrc evaluate, over the boxes given"),
    Protocol(
        name="testbed-per-frame",
        order="frame",
        spaces=_BOTH,
        source="`ap_opencood` of dsrc evaluate, OpenCOOD's order over the boxes given",
    ),
)
PROTOCOLS = {protocol.name: protocol for protocol in _TABLE}
"""Protocols by name."""


def get_protocols(names: str | Protocol | Sequence[str | Protocol], levels: bool = True) -> tuple[Protocol, ...]:
    """Protocols of a name or several, `all` for every one; a struct of one's own stays as it is.

    Args:
        levels: boxes are known in the image, for KITTI's levels; else `all` leaves these out.

    Raises:
        SettingsError: a name is unknown, none is given, or one needs levels.
    """
    given = [names] if isinstance(names, str | Protocol) else list(names)
    found: dict[str, Protocol] = {}
    for one in given:
        if isinstance(one, Protocol):
            found[one.name] = one
        elif one == ALL:
            found |= {name: protocol for name, protocol in PROTOCOLS.items() if levels or protocol.level is None}
        elif one in PROTOCOLS:
            found[one] = PROTOCOLS[one]
        else:
            hint = did_you_mean(one, (*PROTOCOLS, ALL))
            raise SettingsError(complaint("score", "protocol", "the name of a protocol", one, hint))
    if not found:
        raise SettingsError(complaint("score", "protocol", f"at least one of {', '.join(PROTOCOLS)}", "none"))
    rated = next((name for name, protocol in found.items() if protocol.level is not None), None)
    if rated is not None and not levels:
        expected = "KITTI's label files with boxes in the image, of detections and of true boxes"
        raise SettingsError(complaint("score", f"protocol {rated}", expected, "others"))
    return tuple(found.values())
