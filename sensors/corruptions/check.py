"""Contract check of a corruption, custom or built in, on a small analytic street.

| rule                                                     | of                                |
|----------------------------------------------------------|-----------------------------------|
| returns a `Sweep` of the same sensor, time and columns   | all                               |
| finite points, intensities in [0, 1]                     | all                               |
| added points are marked, the others come from a return   | all                               |
| empty sweeps and single points are legal                 | all                               |
| the input is untouched, one seed gives one set of bytes  | all                               |
| every severity changes the frame, a higher one more      | the physical family and callables |
| no surface is reported farther than in clear air         | weather of the physical family    |
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.apply import corrupt_frame, count_lost, surface_points
from sensors.corruptions.physics.levels import DEFAULT_SEVERITY, SEVERITIES
from sensors.corruptions.registry import CORRUPTIONS, Apply, Family, require_corruption
from sensors.frame import AgentFrame, Frame
from sensors.motion import Path
from sensors.spec import LidarSpec
from sensors.sweep import ADDED, POINT_FIELDS, SCATTERED, STATIC, UNKNOWN_MATERIAL, Sweep, make_sweep
from sim.boxes import Boxes
from sim.errors import SettingsError
from sim.geometry import pose_matrix
from sim.mesh.materials import material_index

RANGE_NOISE_M = 0.5
"""Range noise allowed in weather: weak returns may be this much farther than in clear air."""

ORDER_TOLERANCE = 0.005
"""Share of the clean signal by which a higher severity may keep more, by chance."""

_SPEC = LidarSpec(
    name="check", elevation_deg=tuple(np.linspace(8.0, -24.0, 32)), columns=180, range_noise_m=0.0, range_10_m=100.0
)
_SENSOR_Z_M = 1.9
_IDS = (1000, 1001, 1002, 1003)
_PLACES = np.array([[0.0, 0.0], [0.0, 3.5], [14.0, 0.0], [9.0, 3.5]])
_SPEEDS = np.array([9.0, 11.0, 12.0, 10.0])
_SIZE = np.array([4.5, 1.8, 1.5])

Corrupt = Callable[[Frame, int, int], Frame]


def check_corruption(corruption: str | Apply, *, family: Family = "physical", seed: int = 0) -> None:
    """Check that a corruption keeps its contract; see the module for the rules.

    Args:
        corruption: registered kind, or a function `corruption(sweep, severity, rng) -> Sweep`.

    Raises:
        SettingsError: rules are broken, one line for each; or the kind is unknown.
    """
    if isinstance(corruption, str):
        require_corruption(corruption, family=family)
        name, kind = corruption, corruption

        def run(frame: Frame, severity: int, seed: int) -> Frame:
            return corrupt_frame(frame, kind, severity, seed, family)
    else:
        name, function = getattr(corruption, "__name__", repr(corruption)), corruption

        def run(frame: Frame, severity: int, seed: int) -> Frame:
            sweeps = [(agent.sweep, np.random.default_rng([seed, agent.agent_id])) for agent in frame.agents]
            return frame.with_sweeps([count_lost(sweep, function(sweep, severity, rng)) for sweep, rng in sweeps])

    weather = isinstance(corruption, str) and family == "physical" and CORRUPTIONS[corruption].weather
    ordered = not isinstance(corruption, str) or family == "physical"
    found = list(dict.fromkeys(_problems(run, seed, weather, ordered)))
    if found:
        raise SettingsError("\n".join(f"corruption '{name}': {line}" for line in found))


def _problems(run: Corrupt, seed: int, weather: bool, ordered: bool) -> Iterator[str]:
    """Yield one line per broken rule."""
    clean = example_frame()
    empty, single = (clean.with_sweeps([agent.sweep[:few] for agent in clean.agents]) for few in (0, 1))
    signals = [remaining_signal(clean, clean)]
    for severity in SEVERITIES:
        before = _bytes(clean)
        try:
            out = run(clean, severity, seed)
            for few, what in ((empty, "an empty sweep"), (single, "a single point")):
                for line in _frame_problems(few, run(few, severity, seed)):
                    yield f"severity {severity}: {what}: {line}"
        except Exception as error:  # custom code can fail in any way
            yield f"severity {severity}: raised {type(error).__name__}: {error}"
            return
        if _bytes(clean) != before:
            yield f"severity {severity}: expected the input untouched, found it changed in place"
            clean = example_frame()
        broken = list(_frame_problems(clean, out))
        yield from (f"severity {severity}: {line}" for line in broken)
        if broken:
            return
        if weather and (line := _lengthened(clean, out)):
            yield f"severity {severity}: {line}"
        if ordered and _bytes(out) == before:
            yield f"severity {severity}: expected a change, found the clean frame"
        signals.append(remaining_signal(out, clean))
    if _bytes(run(clean, DEFAULT_SEVERITY, seed)) != _bytes(run(clean, DEFAULT_SEVERITY, seed)):
        yield "expected the same bytes for the same seed, found others"
    for severity, (lower, higher) in enumerate(pairwise(signals)):
        if ordered and higher > lower + ORDER_TOLERANCE * signals[0]:
            shares = f"{100 * higher / signals[0]:.1f} % after {100 * lower / signals[0]:.1f} %"
            yield f"severity {severity + 1}: expected less signal than at severity {severity}, found {shares}"


def _frame_problems(before: Frame, after: Frame) -> Iterator[str]:
    for one, other in zip(before.agents, after.agents, strict=True):
        yield from sweep_problems(one.sweep, other.sweep)


def sweep_problems(before: Sweep, after: Sweep) -> list[str]:
    """Return one line per broken rule of a corrupted sweep: types, values, marks of added and lost points."""
    wrong = [name for name in POINT_FIELDS if getattr(after, name).dtype != getattr(before, name).dtype]
    found = [f"{name}: expected {getattr(before, name).dtype}, found {getattr(after, name).dtype}" for name in wrong]
    if (after.spec, after.time_s, after.motion) != (before.spec, before.time_s, before.motion):
        found.append("expected the sensor, time and motion of the input, found others")
    if bad := int(np.count_nonzero(~np.isfinite(after.points).all(axis=1))):
        found.append(f"points: expected finite coordinates, found nan or inf in {bad} of {len(after)}")
    if not ((after.intensity >= 0.0) & (after.intensity <= 1.0)).all():
        found.append(f"intensity: expected 0 to 1, found {after.intensity.min():g} to {after.intensity.max():g}")
    added = after.object_id == ADDED
    if (added != (after.fate == SCATTERED)).any() or after.fate.max(initial=0) > SCATTERED:
        found.append("fate: expected SCATTERED for points of object ADDED and for no others")
    if (after.material[added] != UNKNOWN_MATERIAL).any() or after.cosine[added].any():
        found.append("material: expected UNKNOWN_MATERIAL and cosine 0 for points of object ADDED")
    spec = before.spec
    if spec is not None and not _within(after.ring, spec.rings) & _within(after.column, spec.columns):
        found.append(f"ring, column: expected less than {spec.rings} and {spec.columns} of the sensor")
    lost = before.lost + max(0, surface_points(before) - surface_points(after))
    if after.lost != lost:
        found.append(f"lost: expected {lost}, found {after.lost}")
    real = after[~added]
    if not np.isin(_beam(real), _beam(before)).all():
        found.append("expected surface points from beams with a return, found others")
    return found


def rows_before(after: Sweep, before: Sweep) -> NDArray[np.intp]:
    """Return (P,) rows of surface points in the clean sweep, by ring, column and return number."""
    key = _beam(before)
    order = np.argsort(key)
    place = np.minimum(np.searchsorted(key[order], _beam(after)), len(order) - 1)
    return np.asarray(order[place], np.intp)


def remaining_signal(after: Frame, before: Frame) -> float:
    """Return the sum over surface points of min(i / i_clean, 1) exp(-displacement / 1 m); P of a clean frame."""
    total = 0.0
    for clean, agent in zip(before.agents, after.agents, strict=True):
        sweep = agent.sweep[agent.sweep.object_id != ADDED]
        was = clean.sweep[rows_before(sweep, clean.sweep)]
        off_m = np.linalg.norm(sweep.world_points - was.world_points, axis=1)
        share = np.minimum(sweep.intensity / np.maximum(was.intensity, 1e-6), 1.0)
        total += float((np.exp(-off_m) * share).sum())
    return total


def _lengthened(before: Frame, after: Frame) -> str:
    """Return the line of points behind their clean targets, empty without such points."""
    for clean, agent in zip(before.agents, after.agents, strict=True):
        sweep = agent.sweep[np.isin(_beam(agent.sweep), _beam(clean.sweep))]
        longer = sweep.range - clean.sweep[rows_before(sweep, clean.sweep)].range
        if (count := int(np.count_nonzero(longer > RANGE_NOISE_M))) > 0:
            return f"expected no range beyond the clean one, found {count} of {len(sweep)}, up to {longer.max():.1f} m"
    return ""


def _beam(sweep: Sweep) -> NDArray[np.int64]:
    """Return (P,) keys of ring, column and return number."""
    ring, column = sweep.ring.astype(np.int64), sweep.column.astype(np.int64)
    return (ring << 40) + (column << 8) + sweep.return_number.astype(np.int64)


def _within(index: NDArray[np.integer], count: int) -> bool:
    return bool(((index >= 0) & (index < count)).all())


def _bytes(frame: Frame) -> list[bytes]:
    sweeps = [agent.sweep for agent in frame.agents]
    return [getattr(s, name).tobytes() for s in sweeps for name in (*POINT_FIELDS, "world_from_lidar")]


def example_frame(index: int = 3) -> Frame:
    """Return a frame of two vehicles that drive behind two others between house fronts, 32 rings of 180 columns each.

    Args:
        index: of the frame, 0.1 s apart.
    """
    time_s = 0.1 * index
    places = _PLACES + np.outer(_SPEEDS * time_s, [1.0, 0.0])
    rows = np.concatenate([places, np.tile([0.5 * _SIZE[2], *_SIZE, 0.0], (len(_IDS), 1))], axis=1)
    truth = Boxes.from_array(rows, object_id=np.array(_IDS))
    agents = tuple(_agent(row, time_s, places) for row in range(2))
    points_on = [[np.count_nonzero(agent.sweep.object_id == i) for i in _IDS] for agent in agents]
    velocity = np.stack([_SPEEDS, np.zeros(len(_IDS))], axis=1)
    return Frame(index, time_s, agents, truth, velocity, np.array(points_on, np.int32))


def _agent(row: int, time_s: float, places: NDArray[np.float64]) -> AgentFrame:
    times = time_s + np.array([-0.1, 0.0, 0.1])
    ahead = np.outer(_SPEEDS[row] * (times - time_s), [1.0, 0.0])
    body = pose_matrix(np.column_stack([places[row] + ahead, np.zeros(3)]), np.zeros(3))
    lidar = body @ pose_matrix([0.0, 0.0, _SENSOR_Z_M])
    sweep = replace(_sweep(row, places, lidar[1], time_s), path=Path.through(times, lidar))
    return AgentFrame(_IDS[row], "vehicle", body[1], float(_SPEEDS[row]), sweep)


def _sweep(row: int, places: NDArray[np.float64], pose: NDArray[np.float64], time_s: float) -> Sweep:
    """Return the returns of road, house fronts 8 m to either side and the other vehicles' boxes, seen from a pose."""
    elevation, azimuth = np.meshgrid(_SPEC.elevation, _SPEC.azimuth, indexing="ij")
    ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        road = np.where(ray[..., 2] < 0.0, -_SENSOR_Z_M / ray[..., 2], np.inf)
        walls = (np.where(ray[..., 1] > 0.0, 8.0, -8.0) - pose[1, 3]) / ray[..., 1]
        walls = np.where(np.abs(walls * ray[..., 2]) < 6.0, walls, np.inf)
        distance, owner = [road, walls], [STATIC, STATIC]
        for other, place in enumerate(places):
            if other != row:
                middle = np.array([*place, 0.5 * _SIZE[2]]) - pose[:3, 3]
                ends = np.sort(np.stack([(middle + side * 0.5 * _SIZE) / ray for side in (-1.0, 1.0)]), axis=0)
                first, last = ends[0].max(axis=-1), ends[1].min(axis=-1)
                distance.append(np.where((first > 0.0) & (first < last), first, np.inf))
                owner.append(_IDS[other])
    nearest = np.argmin(distance, axis=0)
    reach = np.min(distance, axis=0)
    ring, column = np.nonzero(reach < 100.0)
    surface = nearest[ring, column]
    points = ray[ring, column] * reach[ring, column, None]
    materials = np.array([material_index(name) for name in ("asphalt", "plaster", "paint_silver")])
    return make_sweep(
        points,
        pose,
        time_s,
        _SPEC,
        intensity=0.1 + 0.5 * np.sin(3.0 * points[:, 0] + 5.0 * points[:, 2]) ** 4,
        ring=ring,
        column=column,
        time_offset=_SPEC.time_offset[ring, column],
        object_id=np.array(owner)[surface],
        material=materials[np.minimum(surface, 2)],
        cosine=np.full(len(points), 0.5),
    )
