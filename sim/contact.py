"""First contact of a moving body with others: instant, closing speed, change of velocity, side and fault."""

import math
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray

from sim.boxes import CLASSES, Boxes
from sim.geometry import wrap_angle
from sim.mesh.materials import MATERIALS
from sim.traffic.base import Actors

Side = Literal["front", "left", "right", "rear"]

MASS_KG = {
    "car": 1500.0,
    "van": 2200.0,
    "truck": 12000.0,
    "bus": 14000.0,
    "motorcycle": 280.0,
    "bicycle": 90.0,
    "pedestrian": 75.0,
}
"""Masses by class with driver or rider, kg: assumed, of the order of kerb masses."""

STANDING_MPS = 0.05
"""Speed below which a body stands: nuPlan's threshold of a stopped agent, m/s."""

_TOUCH_M = 1e-3
_LEAST_SHARE = 1e-4
_ALONG = 0.999
"""Cosine from which on a normal is that of a side of the ego, and not of a body that a corner of it touches."""
_SIDES: tuple[tuple[Side, tuple[float, float]], ...] = (
    ("front", (1.0, 0.0)), ("rear", (-1.0, 0.0)), ("left", (0.0, 1.0)), ("right", (0.0, -1.0)),
)  # fmt: skip

_SOFT = ("asphalt", "marking", "pavement", "kerb", "gravel", "ground", "leaves")
_BUMPER_M = (0.3, 1.5)
_SAMPLE_M = 0.25


@dataclass(frozen=True, slots=True)
class Contact:
    """First contact of the ego.

    Attributes:
        time_s: instant of the contact, s.
        other_id: object id of the other road user; -1 for the static world.
        other: its name; `world` for the static world.
        ego_speed_mps: speed of the ego just before, m/s.
        closing_mps: speed at which the bodies approached along the contact's normal, m/s.
        delta_v_mps: change of the ego's velocity in a plastic impact, m/s.
        side: side of the ego that was touched.
        at_fault: the ego is at fault by nuPlan's rule: it moved, and was not hit from behind, see `first_contact`.
    """

    time_s: float
    other_id: int
    other: str
    ego_speed_mps: float
    closing_mps: float
    delta_v_mps: float
    side: Side
    at_fault: bool


@dataclass(frozen=True, slots=True)
class _Motion:
    """Straight motion of a box between two steps: centre and yaw at the start and their change."""

    xy: NDArray[np.float64]
    yaw: float
    moved: NDArray[np.float64]
    turned: float
    half: NDArray[np.float64]

    @classmethod
    def of(cls, before: Boxes, now: Boxes) -> Self:
        """Motion between two single boxes."""
        moved = now.center[0, :2] - before.center[0, :2]
        turned = float(wrap_angle(now.yaw[0] - before.yaw[0]))
        return cls(before.center[0, :2], float(before.yaw[0]), moved, turned, 0.5 * now.size[0, :2])

    def axes(self, share: float) -> NDArray[np.float64]:
        """Return the (2, 2) directions ahead and left at a share of the step."""
        yaw = self.yaw + share * self.turned
        return np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])

    def center(self, share: float) -> NDArray[np.float64]:
        """Return the (2,) centre at a share of the step, m."""
        return self.xy + share * self.moved

    def outline(self, share: float) -> shapely.Polygon:
        """Return the footprint at a share of the step."""
        ahead, left = self.axes(share) * self.half[:, None]
        center = self.center(share)
        return shapely.Polygon(
            [center + ahead - left, center + ahead + left, center - ahead + left, center - ahead - left]
        )


def first_contact(before: Actors, now: Actors, ego_id: int) -> Contact | None:
    """Return the first contact of the ego with a road user between two steps; None without one.

    Boxes move straight and turn evenly between the steps, so that no body is jumped over. The impact is plastic and
    without friction: along the normal of the contact both have the same velocity afterwards, which depends on
    `MASS_KG`. Fault is nuPlan's (Karnchanachari et al., *Towards learning-based planning: the nuPlan benchmark*, 2024):
    a standing ego and one hit at its rear are not at fault; nuPlan's exception of an ego hit at its side inside one
    lane is left out, since an encounter's crossing paths share lanes.

    Args:
        now: actors now; who was not there before is taken where it is now.
        ego_id: object id of the ego, in both.

    Raises:
        KeyError: the ego is not in both.
    """
    was, row = before.row(ego_id), now.row(ego_id)
    ego = _Motion.of(before.boxes[was : was + 1], now.boxes[row : row + 1])
    first: tuple[float, int, _Motion] | None = None
    for other in _near(before, now, row):
        motion = _motion_of(before, now, int(other))
        share = _share_at_contact(ego, motion)
        if share is not None and (first is None or share < first[0]):
            first = share, int(other), motion
    if first is None:
        return None
    share, other, motion = first
    step_s = now.time_s - before.time_s
    masses = [MASS_KG[CLASSES[int(now.boxes.label[k])]] for k in (row, other)]
    _, normal = _separation(ego, motion, share)
    side = _side(ego, motion, normal, share)
    return _contact(
        ego, motion, normal, side, masses[1] / sum(masses), before.time_s + share * step_s, step_s,
        int(now.boxes.object_id[other]), now.name[other],
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class SolidWorld:
    """Solid parts of a static world seen from above, with their heights.

    Attributes:
        tree: footprints of its triangles, standing ones as lines.
        low_m: (N,) lowest height of each, m.
        high_m: (N,) highest height of each, m.
    """

    tree: shapely.STRtree
    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> Self:
        """Solid parts of a mesh of `sim.world.build.build_world`: all but roads, ground and leaves."""
        soft = [index for index, material in enumerate(MATERIALS) if material.name in _SOFT]
        solid = ~np.isin(mesh.face_attributes["material"], soft)
        triangles = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)[solid]]
        rings = triangles[:, [0, 1, 2, 0], :2]
        # The outline of a triangle: a wall has no area from above.
        lines = shapely.linestrings(rings) if len(rings) else np.zeros(0, object)
        return cls(shapely.STRtree(lines), triangles[..., 2].min(1), triangles[..., 2].max(1))

    def touches(self, outline: shapely.Polygon, ground_m: float) -> bool:
        """Return whether a vehicle on ground of a height touches anything at the height of its bumpers."""
        found = self.tree.query(outline, predicate="intersects")
        low, high = (ground_m + height for height in _BUMPER_M)
        return bool(((self.low_m[found] <= high) & (self.high_m[found] >= low)).any())


def world_contact(before: Actors, now: Actors, ego_id: int, world: SolidWorld) -> Contact | None:
    """Return the first contact of the ego with the static world between two steps; None without one.

    The world does not yield: the ego loses its velocity along its heading, or across it when it is touched at a side.

    Args:
        ego_id: object id of the ego, in both.
        world: solid parts of the world.

    Raises:
        KeyError: the ego is not in both.
    """
    was, row = before.row(ego_id), now.row(ego_id)
    ego = _Motion.of(before.boxes[was : was + 1], now.boxes[row : row + 1])
    ground = float(now.boxes.center[row, 2] - 0.5 * now.boxes.size[row, 2])
    reach = float(np.hypot(*ego.moved)) + abs(ego.turned) * float(np.hypot(*ego.half))
    shares = np.linspace(0.0, 1.0, 1 + max(1, math.ceil(reach / _SAMPLE_M)))
    hit = next((k for k, share in enumerate(shares) if world.touches(ego.outline(share), ground)), None)
    if hit is None:
        return None
    clear, touching = float(shares[max(hit - 1, 0)]), float(shares[hit])
    while touching - clear > _LEAST_SHARE:
        middle = 0.5 * (clear + touching)
        clear, touching = (clear, middle) if world.touches(ego.outline(middle), ground) else (middle, touching)
    axes = ego.axes(touching)
    side, outward = max(_SIDES, key=lambda one: float(ego.moved @ (one[1] @ axes)))
    still = _Motion(ego.xy, 0.0, np.zeros(2), 0.0, np.zeros(2))
    step_s = now.time_s - before.time_s
    time_s = before.time_s + touching * step_s
    return _contact(ego, still, np.array(outward) @ axes, side, 1.0, time_s, step_s, -1, "world")


def _contact(
    ego: _Motion,
    other: _Motion,
    normal: NDArray[np.float64],
    side: Side,
    others_share: float,
    time_s: float,
    step_s: float,
    other_id: int,
    name: str,
) -> Contact:
    """Return the contact of two motions along a normal from the ego to the other."""
    speed = float(np.hypot(*ego.moved)) / step_s
    closing = max(0.0, float((ego.moved - other.moved) @ normal) / step_s)
    return Contact(
        time_s=time_s,
        other_id=other_id,
        other=name,
        ego_speed_mps=speed,
        closing_mps=closing,
        delta_v_mps=others_share * closing,
        side=side,
        at_fault=speed >= STANDING_MPS and (side != "rear" or float(ego.moved @ ego.axes(0.0)[0]) < 0.0),
    )


def _near(before: Actors, now: Actors, row: int) -> NDArray[np.int64]:
    """Return the rows of `now` whose body may have met the one of a row between two steps, at the same height."""
    radius = 0.5 * np.hypot(now.boxes.size[:, 0], now.boxes.size[:, 1])
    start = now.boxes.center[:, :2].copy()
    was = np.searchsorted(before.boxes.object_id, now.boxes.object_id).clip(max=len(before) - 1)
    old = before.boxes.object_id[was] == now.boxes.object_id
    start[old] = before.boxes.center[was[old], :2]
    offset = start - start[row]
    moved = (now.boxes.center[:, :2] - start) - (now.boxes.center[row, :2] - start[row])
    # The nearest approach of two centres that move straight.
    share = np.clip(-(offset * moved).sum(1) / np.maximum((moved**2).sum(1), 1e-12), 0.0, 1.0)
    apart = np.hypot(*(offset + share[:, None] * moved).T)
    height = np.abs(now.boxes.center[:, 2] - now.boxes.center[row, 2])
    level = height < 0.5 * (now.boxes.size[:, 2] + now.boxes.size[row, 2])
    near = (apart < radius + radius[row] + _TOUCH_M) & level
    near[row] = False
    return np.flatnonzero(near)


def _motion_of(before: Actors, now: Actors, row: int) -> _Motion:
    here = now.boxes[row : row + 1]
    was = np.flatnonzero(before.boxes.object_id == now.boxes.object_id[row])
    return _Motion.of(before.boxes[was] if len(was) else here, here)


def _share_at_contact(one: _Motion, other: _Motion) -> float | None:
    """Return the share of the step at which two boxes first touch, by conservative advancement; None if they do not.

    The gap along the best separating axis is never larger than the distance, and the distance shrinks no faster than
    the bodies move and their corners turn (Mirtich, *Impulse-based Dynamic Simulation*, 1996).
    """
    fastest = float(np.hypot(*(one.moved - other.moved)))
    fastest += sum(abs(body.turned) * float(np.hypot(*body.half)) for body in (one, other))
    share = 0.0
    while share <= 1.0:
        gap, _ = _separation(one, other, share)
        if gap <= _TOUCH_M:
            return share
        if fastest <= 0.0:
            return None
        share += max(gap / fastest, _LEAST_SHARE)
    return None


def _separation(one: _Motion, other: _Motion, share: float) -> tuple[float, NDArray[np.float64]]:
    """Return the widest gap along the axes of two boxes, negative in an overlap, and its direction from the first."""
    mine, theirs = one.axes(share), other.axes(share)
    axes = np.concatenate([mine, theirs])
    offset = axes @ (other.center(share) - one.center(share))
    reach = np.abs(axes @ mine.T) @ one.half + np.abs(axes @ theirs.T) @ other.half
    gaps = np.abs(offset) - reach
    best = int(gaps.argmax())
    return float(gaps[best]), axes[best] * (1.0 if offset[best] >= 0.0 else -1.0)


def _side(ego: _Motion, other: _Motion, normal: NDArray[np.float64], share: float) -> Side:
    """Return the side of the ego that was touched; at a corner the one through which the bodies approach faster."""
    axes = ego.axes(share)
    across = axes @ normal
    if np.abs(across).max() < _ALONG:
        closing = across * (axes @ (ego.moved - other.moved))
        across = across * (closing == closing.max())
    return max(_SIDES, key=lambda one: float(across @ one[1]))[0]
