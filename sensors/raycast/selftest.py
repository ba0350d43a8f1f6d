"""The self-test of an engine: a small sweep that must agree with the public engine's."""

import numpy as np

from sensors.beams import beams_of
from sensors.motion import Path
from sensors.noise import draw_noise
from sensors.optics import optics_of
from sensors.raycast.base import Bodies, Engine, Shot, Solid
from sensors.raycast.choice import EngineUnavailable
from sensors.spec import LidarSpec
from sim.geometry import pose_matrix

_SPEC = LidarSpec(
    name="self-test",
    elevation_deg=tuple(np.linspace(10.0, -30.0, 8).tolist()),
    columns=200,
    range_max_m=60.0,
    range_noise_m=0.02,
    dropoff_rate=0.1,
)
_DISTANCE_M = 5e-4
_SILHOUETTES = 5


def self_test(engine: Engine, other: Engine) -> None:
    """Compare the sweeps of two engines through a room with a body that drives and turns, and a hidden one.

    Raises:
        EngineUnavailable: more than a few rays differ, as they may at silhouettes.
    """
    static, bodies, shot = _room(), _bodies(), _shot()
    (made,), (expected,) = (each.sweep(static, bodies, [shot], 1) for each in (engine, other))
    rays = {}
    for name, returns in (("made", made), ("expected", expected)):
        grid = np.full((_SPEC.rings, _SPEC.columns, 5), np.nan)
        place = returns.ring, returns.column
        grid[place] = np.column_stack([returns.points, returns.object_id, returns.material])
        rays[name] = grid.reshape(-1, 5)
    apart = np.abs(rays["made"] - rays["expected"])
    both_missed = np.isnan(rays["made"]).all(axis=1) & np.isnan(rays["expected"]).all(axis=1)
    agree = both_missed | ((apart[:, :3] <= _DISTANCE_M).all(axis=1) & (apart[:, 3:] == 0.0).all(axis=1))
    seen = set(np.unique(expected.object_id).tolist())
    if len(made.points) == 0 or seen != {-1, 1000} or (~agree).sum() > _SILHOUETTES:
        raise EngineUnavailable(
            f"its self-test failed: {int((~agree).sum())} of {len(agree)} rays differ from the public engine's"
        )


def _box(low: tuple[float, float, float], high: tuple[float, float, float], material: int) -> Solid:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
    vertices = np.array(low) + corners * (np.array(high) - np.array(low))
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [[side[a], side[b], side[c]] for side in sides for a, b, c in ((0, 1, 2), (0, 2, 3))]
    return Solid(vertices.astype(np.float32), np.array(faces, np.int32), np.full(12, material, np.uint8))


def _room() -> Solid:
    return _box((-20.0, -15.0, 0.0), (25.0, 18.0, 8.0), 11)


def _bodies() -> Bodies:
    times = np.array([-0.05, 0.0, 0.05])
    ahead = [pose_matrix([8.0 + 12.0 * t, 2.0, 0.0], 0.3 + 0.8 * t) for t in times]
    own = [pose_matrix([3.0 * t, 0.0, 0.0]) for t in times]
    size = np.array([[4.5, 1.8, 1.5]] * 2)
    body = _box((-2.25, -0.9, 0.0), (2.25, 0.9, 1.5), 24)
    path = Path.through(times, np.stack([np.stack(ahead), np.stack(own)]))
    return Bodies(np.array([1000, 1001]), size, (body, body), path, (-0.05, 0.05))


def _shot() -> Shot:
    beams = beams_of(_SPEC, 0.0)
    times = np.linspace(-0.05, 0.05, beams.blocks + 1)
    knots = np.stack([pose_matrix([3.0 * t, 0.0, 1.9], 0.2 * t)[:3] for t in times])
    return Shot(
        spec=_SPEC,
        beams=beams,
        optics=optics_of(_SPEC),
        noise=draw_noise(beams, np.random.default_rng(0)),
        knots=knots,
        pose=pose_matrix([0.0, 0.0, 1.9]),
        time_s=0.0,
        hidden_id=1001,
    )
