"""Contract check of LiDARs, of one's own in particular, as gymnasium's `check_env` of environments."""

from collections.abc import Iterator

import msgspec
import numpy as np
import trimesh

from sensors.presets import get_lidar
from sensors.scan.lidar import scan
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec
from sensors.sweep import POINT_FIELDS, Sweep
from sim.errors import SettingsError
from sim.geometry import pose_matrix

_NOISE = 8.0
"""Standard deviations of the range beyond which a point counts as out of range."""


def check_sensor(sensor: str | LidarSpec) -> None:
    """Check that a LiDAR measures a closed hall around it.

    Values are checked when a `LidarSpec` is made. Checked here: its name, its copy from a drive's files, points in
    every beam, ranges, intensities, firing times, and the same bytes for the same seed.

    Args:
        sensor: name of a preset, or a LiDAR that need not be registered.

    Raises:
        SettingsError: one line per failure; or the name is unknown.
    """
    spec = get_lidar(sensor) if isinstance(sensor, str) else sensor
    failures = list(_failures(spec)) if isinstance(spec, LidarSpec) else [_NO_SPEC.format(type(spec).__name__)]
    if failures:
        name = getattr(spec, "name", repr(spec))
        raise SettingsError("\n".join(f"sensor '{name}': {line}" for line in failures))


_NO_SPEC = "class: expected a LidarSpec, found {}"


def _failures(spec: LidarSpec) -> Iterator[str]:
    """Yield one line per broken rule."""
    if not spec.name or spec.name != spec.name.strip() or "\n" in spec.name:
        yield f"name: expected one line of text, found {spec.name!r}"
    if msgspec.convert(msgspec.to_builtins(spec), LidarSpec) != spec:
        yield "fields: expected the same sensor after writing and reading it, found another"
    if spec.mount_xyz_m[2] <= 0.0:
        yield f"mount_xyz_m: expected a height above the road, found {spec.mount_xyz_m[2]:g} m"
    wall_m = _wall_m(spec)
    if wall_m is None:
        yield f"beam_range_m: expected a range that all beams measure, found none within {spec.range_10_m:g} m"
        return
    sweep = _hall_sweep(spec, wall_m)
    if _bytes(sweep) != _bytes(_hall_sweep(spec, wall_m)):
        yield "expected the same bytes for the same seed, found others"
    silent = sorted(set(range(spec.rings)) - set(sweep.ring.tolist()))
    if silent:
        yield f"beams: expected returns from a wall at {wall_m:.3g} m in each, found none in {silent[:8]}"
    slack_m = _NOISE * spec.range_noise_m + 1e-3
    near, far = spec.beam_range[sweep.ring].T
    outside = np.count_nonzero((sweep.range < near - slack_m) | (sweep.range > far + slack_m))
    if outside:
        yield f"range: expected range_min_m to range_max_m, found {outside} of {len(sweep)} points outside"
    if not ((sweep.intensity >= 0.0) & (sweep.intensity <= 1.0)).all():
        yield f"intensity: expected 0 to 1, found {sweep.intensity.min():g} to {sweep.intensity.max():g}"
    if np.abs(sweep.time_offset).max(initial=0.0) > 0.5 * spec.period_s + 1e-6:
        yield f"firing_s: expected times within half a sweep, found {np.abs(sweep.time_offset).max():.4g} s"


def _wall_m(spec: LidarSpec) -> float | None:
    """Return a distance that all beams measure, to walls of reflectivity 0.1 and more; None without one."""
    low = float(spec.beam_range[:, 0].max())
    high = float(min(spec.beam_range[:, 1].min(), spec.range_10_m))
    # The corners of a cube are sqrt(3) farther away than its walls.
    low, high = 1.05 * low + 0.01, 0.55 * high
    return min(max(low, 8.0), high) if low < high else None


def _hall_sweep(spec: LidarSpec, wall_m: float) -> Sweep:
    still = pose_matrix([0.0, 0.0, 0.0])
    hall = RayScene(trimesh.creation.box((2.0 * wall_m,) * 3))
    return scan(hall, spec, still, still, time_s=0.0, rng=np.random.default_rng(0))


def _bytes(sweep: Sweep) -> list[bytes]:
    return [getattr(sweep, name).tobytes() for name in POINT_FIELDS]
