"""Oracle engine: every ray against every triangle in float64, one beam after another."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sensors.optics.beams import BLOCK
from sensors.optics.noise import ACROSS, LOST_AFTER, LOST_BEFORE, RANGE, SECOND_RANGE, UP
from sensors.optics.reflectance import drop_chance
from sensors.raycast import Bodies, Hits, Returns, Solid, SweepRequest
from sensors.sweep import STATIC
from sim.geometry import invert


class Oracle:
    """Literal implementation of the definition in `sensors.raycast.Engine`."""

    name = "oracle"

    def cast(self, solid: Solid, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> Hits:
        distance, face, cosine = first_hits(solid, origins.astype(float), directions.astype(float), reach.astype(float))
        return Hits(distance.astype(np.float32), face.astype(np.int32), cosine.astype(np.float32))

    def sweep(self, static: Solid, bodies: Bodies, requests: Sequence[SweepRequest], threads: int) -> list[Returns]:
        return [_sweep(static, bodies, request) for request in requests]


def first_hits(
    solid: Solid, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Möller and Trumbore, all rays and triangles at once."""
    distance, face, cosine = reach.copy(), np.full(len(reach), -1), np.zeros(len(reach))
    for row, (a, b, c) in enumerate(solid.vertices.astype(float)[solid.faces]):
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = directions @ normal
            t = (a - origins) @ normal / slope
            offset = origins + t[:, None] * directions - a
            u = np.cross(offset, c - a) @ normal / length**2
            v = np.cross(b - a, offset) @ normal / length**2
            hit = (t >= 0.0) & (t <= distance) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
        distance[hit], face[hit], cosine[hit] = t[hit], row, np.abs(slope[hit]) / length
    return distance, face, cosine


def _sweep(static: Solid, bodies: Bodies, request: SweepRequest) -> Returns:
    spec, beams = request.spec, request.beams
    ring, column = (grid.ravel() for grid in np.mgrid[: beams.rings, : beams.columns])
    pose = _sensor(request, column + beams.firing_share[ring].astype(float))
    time_s = request.time_s + spec.time_offset.ravel()
    seen = [_seen(static, bodies, request, pose, time_s, ring, column, ray) for ray in range(len(beams.subray))]
    rows = []
    for beam in range(len(ring)):
        rows += _beam(request, ring[beam], column[beam], pose[beam], [tuple(v[beam] for v in ray) for ray in seen])
    dtypes = (np.float32, np.float32, np.int16, np.int32, np.float32, np.int32, np.uint8, np.uint8, np.float32)
    columns: list[Any] = list(zip(*rows, strict=True)) or [np.zeros((0, 3)), *[()] * (len(dtypes) - 1)]
    return Returns(*(np.array(v, dtype) for v, dtype in zip(columns, dtypes, strict=True)))


def _sensor(request: SweepRequest, column: np.ndarray) -> np.ndarray:
    block = np.minimum(column // BLOCK, len(request.knots) - 2).astype(int)
    share = (column / BLOCK - block)[:, None, None]
    return (1.0 - share) * request.knots[block] + share * request.knots[block + 1]


def _seen(
    static: Solid,
    bodies: Bodies,
    request: SweepRequest,
    pose: np.ndarray,
    time_s: np.ndarray,
    ring: np.ndarray,
    column: np.ndarray,
    ray: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return distance (inf where nothing is), cosine, material and object of one sub-ray of all beams."""
    axis = request.beams.subray[ray, :, ring, column].astype(float)
    x, y, z = axis.T
    level = np.hypot(x, y)
    sigma = np.radians(request.spec.angle_noise_deg)
    across, up = (
        sigma * request.noise.normal[request.noise.start[row, ring] + column][:, None] for row in (ACROSS, UP)
    )
    horizon = np.stack([-y, x, 0.0 * x], axis=1) / level[:, None]
    meridian = np.stack([-x * z, -y * z, level**2], axis=1) / level[:, None]
    axis = axis + across * horizon + up * meridian
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    direction, place = np.einsum("nij,nj->ni", pose[:, :, :3], axis), pose[:, :, 3]
    reach = request.beams.reach[ring, 1].astype(float)
    distance, face, cosine = first_hits(static, place - static.origin, direction, reach)
    hit = face >= 0
    material = static.material[face] if len(static.material) else np.zeros(len(face), np.uint8)
    object_id = np.full(len(face), STATIC)
    for row, solid in enumerate(bodies.solids):
        if bodies.object_id[row] == request.hidden_id:
            continue
        body_from_world = invert(bodies.path[row].at(time_s))
        origins = np.einsum("nij,nj->ni", body_from_world[:, :3, :3], place) + body_from_world[:, :3, 3]
        directions = np.einsum("nij,nj->ni", body_from_world[:, :3, :3], direction)
        distance, face, towards = first_hits(solid, origins, directions, distance)
        nearer = face >= 0
        hit |= nearer
        cosine, object_id = np.where(nearer, towards, cosine), np.where(nearer, bodies.object_id[row], object_id)
        material = np.where(nearer, solid.material[face], material)
    return np.where(hit, distance, np.inf), cosine, material, object_id


def _table(values: np.ndarray, place: float) -> float:
    return float(np.interp(place * (len(values) - 1), np.arange(len(values)), values))


def _beam(
    request: SweepRequest, ring: int, column: int, pose: np.ndarray, rays: list[tuple[float, float, int, int]]
) -> list[tuple]:
    """Return the rows of one beam from (distance, cosine, material, object) of its rays."""
    spec, optics, noise = request.spec, request.optics, request.noise
    share = 1.0 / len(rays)
    hits = []
    for distance, cosine, material, object_id in sorted((r for r in rays if np.isfinite(r[0])), key=lambda r: r[0]):
        power = share * _table(optics.power[material], cosine)
        margin = power / _table(optics.need, distance / optics.reach_m)
        if power > 0.0:
            hits.append((distance, power, margin, cosine, material, object_id))
    groups: list[list] = []
    for hit in hits:
        if groups and hit[0] - groups[-1][-1][0] <= optics.gate_m:
            groups[-1].append(hit)
        else:
            groups.append([hit])
    echoes = []
    for group in groups:
        margin = sum(hit[2] for hit in group)
        if margin >= 1.0:
            mean = sum(hit[0] * hit[2] for hit in group) / margin
            echoes.append((mean, sum(hit[1] for hit in group), margin, *max(group, key=lambda hit: hit[2])[3:]))
    if not echoes or noise.uniform[noise.start[LOST_BEFORE, ring] + column] < spec.dropoff_rate:
        return []
    strength = [echo[2] for echo in echoes]
    strongest, last = int(np.argmax(strength)), len(echoes) - 1
    chosen = {strongest} if spec.returns != "last" else {last}
    if spec.returns == "dual" and last > 0:
        chosen.add(last if last != strongest else int(np.argmax(strength[:-1])))
    rows = []
    for number, index in enumerate(sorted(chosen)):
        distance, power, _, cosine, material, object_id = echoes[index]
        scale = _table(optics.scale, distance / optics.reach_m)
        intensity = min(1.0, power * scale if optics.of_material else scale)
        row = SECOND_RANGE if number else RANGE
        measured = distance + spec.range_noise_m * float(noise.normal[noise.start[row, ring] + column])
        near, far = request.beams.reach[ring]
        chance = float(drop_chance(np.array([intensity], np.float32), spec)[0])
        lost = noise.uniform[noise.start[LOST_AFTER, ring] + column] < chance
        if lost or distance < near or not near <= measured <= far:
            continue
        world = pose[:, :3] @ request.beams.axis[:, ring, column] * measured + pose[:, 3]
        point = invert(request.pose)[:3, :3] @ world + invert(request.pose)[:3, 3]
        after = spec.time_offset[ring, column]
        rows.append((point, intensity, ring, column, after, object_id, number + 1, material, cosine))
    return rows


assert Returns._fields[:2] == ("points", "intensity")
