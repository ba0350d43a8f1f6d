"""Self-test of an engine: small sweeps that must agree with the public engine's."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.motion import Path
from sensors.optics.beams import beams_of
from sensors.optics.noise import draw_noise
from sensors.optics.reflectance import optics_of
from sensors.raycast.base import Bodies, Engine, EngineUnavailable, Returns, Solid, SweepRequest
from sensors.spec import LidarSpec, Prism
from sim.geometry import pose_matrix

_PLAIN = LidarSpec(
    name="self-test",
    elevation_deg=tuple(np.linspace(10.0, -30.0, 8).tolist()),
    columns=200,
    range_max_m=60.0,
    range_noise_m=0.02,
    dropoff_rate=0.1,
)
_SPECS = (
    _PLAIN,
    msgspec.structs.replace(
        _PLAIN,
        elevation_deg=(2.0, -3.0, -8.0, -15.0),
        columns=100,
        firing_s=(0.0, 2e-4, 4e-4, 6e-4),
        range_10_m=12.0,
        angle_noise_deg=0.3,
        dropoff_zero_intensity=0.5,
        divergence_rad=0.06,
        subrays=4,
        pulse_s=4e-9,
        returns="dual",
        intensity_law="power",
    ),
    msgspec.structs.replace(
        _PLAIN,
        elevation_deg=(0.0,),
        columns=400,
        prisms=(Prism(-130.0, 18.0, 1.51), Prism(70.0, 17.0, 1.51)),
        divergence_rad=0.03,
        subrays=8,
        returns="last",
    ),
)
"""Sensors: one ray per beam; divided beams with two returns, jitter and losses by power; a rosette."""
_TOLERANCE = np.array([5e-4, 5e-4, 5e-4, 4e-3, 1e-2, 1e-6, 0.0, 0.0])
"""Of `_rows`."""
_SILHOUETTES = 5


def self_test(engine: Engine, other: Engine) -> None:
    """Compare the sweeps of two engines through a room with a moving, turning body and a hidden one.

    Raises:
        EngineUnavailable: more than a few returns of a sweep differ, as they may at silhouettes.
    """
    room = _box((-20.0, -15.0, 0.0), (25.0, 18.0, 8.0), 11)
    bodies, requests = _bodies(), [_request(spec) for spec in _SPECS]
    for request, made, expected in zip(
        requests, *(each.sweep(room, bodies, requests, 1) for each in (engine, other)), strict=True
    ):
        rows, others = _rows(made, request.spec), _rows(expected, request.spec)
        both_missed = np.isnan(rows[:, 0]) & np.isnan(others[:, 0])
        agree = both_missed | (np.abs(rows - others) <= _TOLERANCE).all(axis=1)
        seen = set(np.unique(expected.object_id).tolist())
        if len(made.points) == 0 or seen != {-1, 1000} or (~agree).sum() > _SILHOUETTES:
            count = f"{int((~agree).sum())} of {len(agree)}"
            raise EngineUnavailable(f"its self-test failed: {count} returns differ from the public engine's")


def _rows(returns: Returns, spec: LidarSpec) -> NDArray[np.float64]:
    """Return (2 R C, 8) measurements of each beam's two returns, NaN where missing."""
    grid = np.full((spec.rings, spec.columns, 2, len(_TOLERANCE)), np.nan)
    columns = returns.points, returns.intensity, returns.cosine, returns.time_offset
    measured = np.column_stack([*columns, returns.object_id, returns.material])
    grid[returns.ring, returns.column, returns.return_number - 1] = measured
    return grid.reshape(-1, len(_TOLERANCE))


def _box(low: tuple[float, float, float], high: tuple[float, float, float], material: int) -> Solid:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
    vertices = np.array(low) + corners * (np.array(high) - np.array(low))
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [[side[a], side[b], side[c]] for side in sides for a, b, c in ((0, 1, 2), (0, 2, 3))]
    return Solid(vertices.astype(np.float32), np.array(faces, np.int32), np.full(12, material, np.uint8))


def _bodies() -> Bodies:
    times = np.array([-0.05, 0.0, 0.05])
    ahead = [pose_matrix([8.0 + 12.0 * t, 2.0, 0.0], 0.3 + 0.8 * t) for t in times]
    own = [pose_matrix([3.0 * t, 0.0, 0.0]) for t in times]
    size = np.array([[4.5, 1.8, 1.5]] * 2)
    body = _box((-2.25, -0.9, 0.0), (2.25, 0.9, 1.5), 24)
    path = Path.through(times, np.stack([np.stack(ahead), np.stack(own)]))
    return Bodies(np.array([1000, 1001]), size, (body, body), path, (-0.05, 0.05))


def _request(spec: LidarSpec) -> SweepRequest:
    beams = beams_of(spec, 0.0)
    times = np.linspace(-0.05, 0.05, beams.blocks + 1)
    knots = np.stack([pose_matrix([3.0 * t, 0.0, 1.9], 0.2 * t)[:3] for t in times])
    return SweepRequest(
        spec=spec,
        beams=beams,
        optics=optics_of(spec),
        noise=draw_noise(beams, np.random.default_rng(0)),
        knots=knots,
        pose=pose_matrix([0.0, 0.0, 1.9]),
        time_s=0.0,
        hidden_id=1001,
    )
