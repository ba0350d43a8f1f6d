"""Corruption of single clouds, without a drive around them.

A cloud is taken for a frame of a drive with one agent, id 0, whose sensor is the origin: it gets the bytes that
`corrupt_frame` gives that frame. Kinds that act on objects need boxes, or a mask of the points on vehicles.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dsrc.data.clouds.cloud import Cloud
from dsrc.data.clouds.columns import meaning, parse_columns
from dsrc.data.clouds.intensity import Scale, parse_scale
from dsrc.data.formats.pcd import padded
from sensors.corruptions import CLEAN, CORRUPTIONS, DEFAULT_SEVERITY, Condition, Family, settings_of
from sensors.corruptions.incomplete_echo import on_vehicles
from sensors.frame import AgentFrame, Frame
from sensors.presets import get_lidar
from sensors.spec import LidarSpec
from sensors.sweep import Sweep
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError, complaint

Points = TypeVar("Points", NDArray[np.generic], Sweep)

INTERVAL_S = 0.1
"""Time from one frame to the next."""
SPEED_MPS = 10.0
"""Assumed speed of a sensor, for which the shares of `motion_blur` are set."""


def corrupt(
    points: Points,
    kind: str,
    severity: int | None = None,
    seed: int = 0,
    *,
    sensor: str | LidarSpec | None = None,
    boxes: ArrayLike | None = None,
    on_vehicle: NDArray[np.bool_] | None = None,
    ring: int | None = None,
    columns: Sequence[str] | None = None,
    intensity_scale: Scale | None = None,
    family: Family | None = None,
    preset: str | None = None,
    index: int = 0,
    speed: float = SPEED_MPS,
) -> Points:
    """Corrupt one cloud: an array of points of any data set, or a sweep.

    Args:
        points: (P, C) x forward, y left, z up in the sensor frame, m; intensity where C > 3; or (P,) with named fields
            x, y, z and perhaps intensity and ring; or a `Sweep`. Further columns stay with their points and are 0 in
            added ones. Rows without a return, at the origin or not finite, stay as they are.
        kind: key of `sensors.corruptions.CORRUPTIONS`, or `clean`.
        severity: 1 to 5; None for 3, the DSRC paper's, or with a preset.
        seed: of the drive; its weather and its faults that stay are the same for all `index`.
        sensor: LiDAR or name of a preset; None finds rings by elevation where a kind needs them, and takes the
            HDL-64E's detection limit. A sweep has its own, and its own rings and objects.
        boxes: (M, 7) x, y, z, l, w, h, yaw of the vehicles in the sensor frame, centres, m and rad; or (M, 9) with
            velocities x, y, m/s.
        on_vehicle: (P,) mask of the points on vehicles, instead of boxes.
        ring: column of the beam index, from the top or from the bottom; None where there is none.
        columns: names of the C columns in order, with x, y and z, and perhaps intensity and ring; None for x y z
            intensity and anything. A column of no matter may be `_`.
        intensity_scale: intensity that means 1, such as 65535, or `waymo`; None finds 1 or 255 in the points.
        family: of the settings: physical causes or published models; None for physical, or with a preset.
        preset: published settings by name in place of `severity` and `family`, see `sensors.corruptions.PRESETS`.
        index: number of the frame, 0.1 s apart.
        speed: of the sensor along x, m/s; for `motion_blur`.

    Returns:
        (Q, C) or (Q,) array of the type of `points`, or a sweep.

    Raises:
        SettingsError: an unknown kind, severity, family, preset or sensor, arguments that exclude each other, or a kind
            that needs boxes or other agents.
        DataError: points, boxes or rings of a wrong shape or value, or the cloud lacks what the kind needs.
    """
    of, _ = settings_of(kind, severity, family, preset)
    condition = Condition(kind, DEFAULT_SEVERITY if severity is None else severity, of, preset=preset)
    frame: dict[str, Any] = {"boxes": boxes, "index": index, "speed": speed}
    if boxes is not None and on_vehicle is not None:
        raise SettingsError(complaint("corrupt", "boxes", "either boxes or on_vehicle", "both"))
    if isinstance(points, Sweep):
        given: dict[str, Any] = {"sensor": sensor, "on_vehicle": on_vehicle, "ring": ring, "columns": columns}
        given["intensity_scale"] = intensity_scale
        if found := [name for name, value in given.items() if value is not None]:
            raise SettingsError(f"corrupt: a sweep has its own; leave out {found[0]}")
        labelled = bool((points.object_id >= 0).any())
        return corrupt_sweep(points, condition, seed, labelled=labelled, **frame)
    cloud = cloud_of(points, ring, columns, intensity_scale)
    spec = get_lidar(sensor) if isinstance(sensor, str) else sensor
    if on_vehicle is not None and np.shape(on_vehicle) != (len(cloud),):
        raise DataError(complaint("corrupt", "on_vehicle", f"a mask of shape ({len(cloud)},)", np.shape(on_vehicle)))
    before = cloud.sweep(spec, on_vehicle)
    after = corrupt_sweep(before, condition, seed, labelled=on_vehicle is not None, **frame)
    return array_of(cloud.of(after), np.asarray(points).dtype)


def cloud_of(
    points: ArrayLike,
    ring: int | None = None,
    columns: Sequence[str] | None = None,
    intensity_scale: Scale | None = None,
) -> Cloud:
    """Return an array of points as a cloud.

    Args:
        points: (P, C) x, y, z, intensity where C > 3, anything; or `columns`; or (P,) with named fields.
        ring: column of the beam index.
        columns: names of the columns.
        intensity_scale: see `corrupt`.

    Raises:
        DataError: points of another shape or type.
        SettingsError: a ring that is no column, or that is named too; a name that is missing or comes twice.
    """
    rows, names, scale = np.ascontiguousarray(points), parse_columns(columns), parse_scale(intensity_scale)
    if rows.dtype.names and rows.ndim == 1:
        for option_name, given in (("columns", names), ("ring", ring)):
            if given is not None:
                found = f"fields {' '.join(rows.dtype.names)}"
                raise SettingsError(complaint("corrupt", option_name, "none with points that name their fields", found))
        return Cloud.named("points", rows, scale)
    if rows.ndim != 2 or rows.shape[1] < 3 or rows.dtype.kind != "f":
        found = f"{rows.dtype} {rows.shape}"
        raise DataError(
            complaint("points", "shape", "floats of shape (P, 3), (P, 4) or more columns, or (P,) with fields", found)
        )
    width = rows.shape[1]
    if ring is not None and (names is not None or not 3 <= ring < width):
        expected = f"a column from 3 to {width - 1}, or its name among the columns"
        raise SettingsError(complaint("corrupt", "ring", expected, ring))
    if names is None:
        fields = [str(column) for column in range(width)]
        intensity = "3" if width > 3 and ring != 3 else None
        return Cloud(_table(rows, fields), ("0", "1", "2"), intensity, None if ring is None else str(ring), scale)
    if len(names) != width:
        raise DataError(
            complaint("points", "columns", f"{width}, as the points have", f"{len(names)}: {','.join(names)}")
        )
    fields = [padded(name, column) for column, name in enumerate(names)]
    return Cloud(_table(rows, fields), *meaning("points", fields), scale)


def _table(rows: NDArray[np.generic], fields: list[str]) -> NDArray[np.void]:
    return rows.view([(name, rows.dtype) for name in fields])[:, 0]


def array_of(table: NDArray[np.void], dtype: np.dtype) -> NDArray[np.generic]:
    """Return (P, C) array of a table whose columns are all of one type; the table itself for a type with fields."""
    if dtype.names:
        return table
    return np.ascontiguousarray(table).view(dtype).reshape(len(table), len(table.dtype.names or ()))


def corrupt_sweep(
    sweep: Sweep,
    condition: Condition,
    seed: int,
    *,
    boxes: ArrayLike | None = None,
    labelled: bool = False,
    index: int = 0,
    time_s: float | None = None,
    speed: float = SPEED_MPS,
) -> Sweep:
    """Return a sweep under a condition, as that of the only agent of a frame.

    The other arguments and the errors are those of `corrupt`. Ids of a `labelled` sweep tell which points are on
    objects; `time_s` is that of the frame, s, None for 0.1 s times its number.
    """
    if seed < 0 or index < 0:
        raise SettingsError(complaint("corrupt", "seed and index", "at least 0", f"{seed} and {index}"))
    if condition.kind == CLEAN:
        return sweep
    time_s = INTERVAL_S * index if time_s is None else time_s
    truth, velocity = _truth(sweep, boxes, labelled)
    corruption = CORRUPTIONS[condition.kind]
    where = f"corruption '{condition.kind}'"
    if corruption.spares_ego:
        raise SettingsError(complaint(where, "points", "frames of several agents, as in a drive", "a single cloud"))
    if corruption.of_objects and len(truth) == 0:
        if boxes is not None or labelled:
            return sweep  # nobody is there
        labels = " with velocities" if corruption.apply is None else ", or labels of the points"
        raise SettingsError(complaint(where, "boxes", f"boxes of the vehicles{labels}", "none"))
    if corruption.apply is None and not velocity.any() and len(truth):
        raise SettingsError(complaint(where, "boxes", "velocities in columns 7 and 8, m/s", "none"))
    agent = AgentFrame(0, "vehicle", np.eye(4), speed, sweep)
    counts = np.zeros((1, len(truth)), np.int32)
    frame = Frame(index, time_s, (agent,), truth, velocity, counts)
    try:
        done = condition.apply(frame, seed)
    except DataError as error:
        raise DataError(str(error).removeprefix(f"frame {index}: agent 0: ")) from None
    return done.agents[0].sweep


def _truth(sweep: Sweep, boxes: ArrayLike | None, labelled: bool) -> tuple[Boxes, NDArray[np.float64]]:
    """Return the N objects of a sweep and (N, 2) their velocities: its boxes, or those of its ids."""
    if boxes is None:
        ids = np.unique(sweep.object_id[on_vehicles(sweep)]) if labelled else np.zeros(0, np.int64)
        return Boxes.from_array(np.zeros((len(ids), 7)), object_id=ids), np.zeros((len(ids), 2))
    rows = np.asarray(boxes, np.float64)
    rows = rows.reshape(0, 9) if rows.size == 0 else rows
    if rows.ndim != 2 or rows.shape[1] not in (7, 9) or not np.isfinite(rows).all():
        raise DataError(complaint("corrupt", "boxes", "finite numbers of shape (M, 7) or (M, 9)", f"{rows.shape}"))
    velocity = rows[:, 7:] if rows.shape[1] == 9 else np.zeros((len(rows), 2))
    return Boxes.from_array(rows[:, :7], object_id=np.arange(len(rows))), velocity
