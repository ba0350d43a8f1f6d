"""LidarSpec: settings of a LiDAR. The named sensors are in `sensors.presets`."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, Literal, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from sim.errors import SettingsError, complaint

Returns = Literal["strongest", "last", "dual"]
IntensityLaw = Literal["reflectivity", "distance", "power"]

MOST_RAYS = 20_000_000
"""Most rays of one sweep, sub-rays included: a table of directions for more would not fit into memory."""
MOST_BEAMS = np.iinfo(np.int16).max
"""Most beams: a point's ring is an int16."""


class Prism(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One rotating wedge of a Risley scanner.

    Attributes:
        rate_hz: rotations per second, negative when clockwise as seen along the beam.
        wedge_deg: angle between its faces.
        refraction: refractive index.
        slanted_exit: the beam leaves by the slanted face; else it enters by it. The other face is square to the axis.

    Raises:
        SettingsError: a value of another type.
    """

    rate_hz: float
    wedge_deg: float
    refraction: float
    slanted_exit: bool = False

    def __post_init__(self) -> None:
        _check_types(self, "Prism")


class LidarSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A LiDAR whose beams fire together, or one shortly after another, in each of `columns` firings per sweep.

    Tables of beams have one value per beam, or none where all beams are alike. They may be given as lists or arrays and
    are kept as tuples, so that sensors compare and hash by value.

    Attributes:
        name: preset name.
        elevation_deg: beam elevations, highest first: ring 0 is the top beam.
        azimuth_offset_deg: azimuth of each beam beyond that of its column, counter-clockwise.
        columns: firings per sweep.
        rate_hz: sweeps per second.
        firing_s: how long after the start of its column each beam fires, s; left out: all in its middle. The head turns
            on in between.
        rolling_shutter: columns fire one after another; False freezes the world, as CARLA's sensor does in a tick.
        clockwise: turns clockwise as seen from above, from `azimuth_end_deg` down; else counter-clockwise.
        azimuth_start_deg, azimuth_end_deg: field of view, counter-clockwise from straight ahead.
        prisms: wedges of a Risley scanner; with them the beams follow a rosette that does not repeat, a column is one
            firing, `elevation_deg` and `azimuth_offset_deg` say where each line points before the prisms.
        range_min_m, range_max_m: nearest and farthest range.
        beam_range_m: (nearest, farthest) range of each beam, within those of the sensor.
        range_10_m: range at which a target of reflectivity 0.1, hit squarely, is just detected in clear air.
        range_noise_m: standard deviation of the range.
        angle_noise_deg: standard deviation of the true direction around the reported one, in azimuth and elevation.
        dropoff_rate: share of beams lost at random before anything is measured (CARLA's general drop-off).
        dropoff_intensity_limit: returns of at least this intensity are never lost.
        dropoff_zero_intensity: chance that a return of zero intensity is lost, at any range; linear up to the limit.
            That is CARLA's model: real sensors lose what is too weak by `range_10_m`.
        divergence_rad: full beam divergence (1/e^2), horizontal.
        divergence_vertical_rad: vertical, when the beam is not round.
        subrays: rays per beam, 1, 4 or 8, spread over its divergence; their echoes are merged by the pulse length.
        pulse_s: pulse length at half power.
        returns: which echoes of a beam are reported: the strongest, the last, or both (the second strongest when the
            strongest is the last). One ray per beam has one echo.
        intensity_law: `reflectivity`: calibrated, independent of range in clear air; `distance`: exp(-attenuation *
            range) whatever was hit, as CARLA's; `power`: received power, as 1/range^2, 1 for a white target at 10 m.
        attenuation: of the `distance` law, 1/m.
        blocked_deg: sectors that the carrier hides: (azimuth from, azimuth to, counter-clockwise from straight ahead,
            elevation); beams below the elevation return nothing there. Unset: none.
        intensity_curve: (intensity by the law, intensity reported) knots from 0 on, linear in between: the scale of the
            sensor itself, fitted to its sweeps. Beyond 1 lie retroreflectors. Unset: the law's, cut off at 1.
        intensity_fade_m: range from which on the reported intensity falls, and that at which it is 0; unset: none.
        lacquer: share of the diffuse light of vehicles' paint that comes back through its clear coat, which mirrors the
            rest away; unset: paint is a rough surface without a coat.
        own_body: the body that carries the sensor is seen, as real sensors do; datasets crop it.
        mount_xyz_m: sensor above the footprint's centre at road level for vehicles, in the body frame.
        source: the document that the numbers come from.
        assumed: fields whose values no document gave.

    Raises:
        SettingsError: a value of another type or that no sensor has, NaN included; it names the field, what was
            expected and what was found.
    """

    name: str
    elevation_deg: tuple[float, ...]
    azimuth_offset_deg: tuple[float, ...] = ()
    columns: int
    rate_hz: float = 10.0
    firing_s: tuple[float, ...] = ()
    rolling_shutter: bool = True
    clockwise: bool = False
    azimuth_start_deg: float = -180.0
    azimuth_end_deg: float = 180.0
    prisms: tuple[Prism, ...] = ()
    range_min_m: float = 0.5
    range_max_m: float = 120.0
    beam_range_m: tuple[tuple[float, float], ...] = ()
    range_10_m: float = 100.0
    range_noise_m: float = 0.02
    angle_noise_deg: float = 0.0
    dropoff_rate: float = 0.0
    dropoff_intensity_limit: float = 0.8
    dropoff_zero_intensity: float = 0.0
    divergence_rad: float = 0.003
    divergence_vertical_rad: float | None = None
    subrays: int = 1
    pulse_s: float = 1e-8
    returns: Returns = "strongest"
    intensity_law: IntensityLaw = "reflectivity"
    attenuation: float = 0.004
    # Unset fields are not written: files of sensors without them keep their bytes.
    blocked_deg: tuple[tuple[float, float, float], ...] | msgspec.UnsetType = msgspec.UNSET
    intensity_curve: tuple[tuple[float, float], ...] | msgspec.UnsetType = msgspec.UNSET
    intensity_fade_m: tuple[float, float] | msgspec.UnsetType = msgspec.UNSET
    lacquer: float | msgspec.UnsetType = msgspec.UNSET
    own_body: bool = False
    mount_xyz_m: tuple[float, float, float] = (0.0, 0.0, 1.9)
    source: str = ""
    assumed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check_types(self, f"LidarSpec '{self.name}'")
        for field, expected, holds in self._facts():
            if not holds:
                raise SettingsError(complaint(f"LidarSpec '{self.name}'", field, expected, getattr(self, field)))

    def _facts(self) -> list[tuple[str, str, bool]]:
        """Return (field, expected value, whether it holds) of all checks; comparisons with NaN do not hold."""
        table, beams = self.elevation_deg, len(self.elevation_deg)
        per_beam = f"one value for each of the {beams} beams, or none"
        nearest, farthest = self.range_min_m, self.range_max_m
        column_s = self.period_s / self.columns if self.columns > 0 and self.rate_hz > 0.0 else 0.0
        vertical = self.divergence_rad if self.divergence_vertical_rad is None else self.divergence_vertical_rad
        return [
            ("elevation_deg", "at least one beam", beams > 0),
            ("elevation_deg", f"at most {MOST_BEAMS} beams", beams <= MOST_BEAMS),
            ("elevation_deg", "angles within +-90", all(-90.0 <= angle <= 90.0 for angle in table)),
            ("elevation_deg", "the highest beam first", all(a >= b for a, b in pairwise(table))),
            ("columns", "at least 1", self.columns >= 1),
            ("subrays", "1, 4 or 8", self.subrays in (1, 4, 8)),
            ("columns", f"at most {MOST_RAYS} rays per sweep", beams * self.columns * self.subrays <= MOST_RAYS),
            ("rate_hz", "a positive rate", 0.0 < self.rate_hz < math.inf),
            ("azimuth_offset_deg", per_beam, len(self.azimuth_offset_deg) in (0, beams)),
            ("azimuth_offset_deg", "angles within +-180", all(-180.0 <= a <= 180.0 for a in self.azimuth_offset_deg)),
            ("firing_s", per_beam, len(self.firing_s) in (0, beams)),
            ("firing_s", f"times in [0, {column_s:.3g}) s", all(0.0 <= t < column_s for t in self.firing_s)),
            ("azimuth_start_deg", "within +-360", -360.0 <= self.azimuth_start_deg <= 360.0),
            (
                "azimuth_end_deg",
                "more than azimuth_start_deg, by at most 360",
                0.0 < self.azimuth_end_deg - self.azimuth_start_deg <= 360.0 + 1e-9,  # start + 360 is rounded
            ),
            (
                "prisms",
                "finite rates, wedges within 45 degrees and refraction of at least 1",
                all(math.isfinite(p.rate_hz) and 0 < p.wedge_deg < 45 and 1 <= p.refraction < 4 for p in self.prisms),
            ),
            ("range_min_m", "0 <= range_min_m < range_max_m", 0.0 <= nearest < farthest),
            ("range_max_m", "a finite range", farthest < math.inf),
            ("beam_range_m", per_beam, len(self.beam_range_m) in (0, beams)),
            (
                "beam_range_m",
                "nearest < farthest, within those of the sensor",
                all(nearest <= near < far <= farthest for near, far in self.beam_range_m),
            ),
            ("range_10_m", "a positive range", 0.0 < self.range_10_m < math.inf),
            ("range_noise_m", "at least 0", 0.0 <= self.range_noise_m < math.inf),
            ("angle_noise_deg", "0 to 10", 0.0 <= self.angle_noise_deg <= 10.0),
            ("dropoff_rate", "a share in [0, 1]", 0.0 <= self.dropoff_rate <= 1.0),
            ("dropoff_intensity_limit", "a share in [0, 1]", 0.0 <= self.dropoff_intensity_limit <= 1.0),
            ("dropoff_zero_intensity", "a share in [0, 1]", 0.0 <= self.dropoff_zero_intensity <= 1.0),
            ("divergence_rad", "0 to 0.1 rad", 0.0 <= self.divergence_rad <= 0.1),
            ("divergence_vertical_rad", "0 to 0.1 rad", 0.0 <= vertical <= 0.1),
            ("pulse_s", "0 to 1 microsecond", 0.0 < self.pulse_s <= 1e-6),
            ("attenuation", "at least 0", 0.0 <= self.attenuation < math.inf),
            *self._calibration_facts(),
            ("mount_xyz_m", "finite coordinates", all(map(math.isfinite, self.mount_xyz_m))),
            ("returns", f"one of {get_args(Returns)}", self.returns in get_args(Returns)),
            ("intensity_law", f"one of {get_args(IntensityLaw)}", self.intensity_law in get_args(IntensityLaw)),
            ("assumed", "names of fields", set(self.assumed) <= set(self.__struct_fields__)),
        ]

    def _calibration_facts(self) -> list[tuple[str, str, bool]]:
        """Return the checks of the fields that may be unset."""
        facts = []
        if self.blocked_deg is not msgspec.UNSET:
            real = all(-180.0 <= start < end <= 180.0 and -90.0 <= top <= 90.0 for start, end, top in self.blocked_deg)
            facts.append(
                ("blocked_deg", "sectors within +-180 below +-90, of a head that turns", real and not self.prisms)
            )
        if self.intensity_curve is not msgspec.UNSET:
            curve, lossless = self.intensity_curve, self.dropoff_zero_intensity == 0.0
            grows = all(a < b and low <= high for (a, low), (b, high) in pairwise(curve))
            whole = len(curve) > 1 and curve[0] == (0.0, 0.0) and curve[-1][0] < math.inf and curve[-1][1] <= 1.0
            facts += [
                ("intensity_curve", "knots from (0, 0) on that grow, up to 1", whole and grows),
                ("intensity_law", "'reflectivity' beside intensity_curve", self.intensity_law == "reflectivity"),
                ("dropoff_zero_intensity", "0 beside intensity_curve", lossless),
            ]
        if self.intensity_fade_m is not msgspec.UNSET:
            near, far = self.intensity_fade_m
            facts.append(("intensity_fade_m", "two ranges that grow", 0.0 <= near < far < math.inf))
        if self.lacquer is not msgspec.UNSET:
            facts.append(("lacquer", "a share in [0, 1]", 0.0 <= self.lacquer <= 1.0))
        return facts

    @property
    def rings(self) -> int:
        """Number of beams."""
        return len(self.elevation_deg)

    @property
    def elevation(self) -> NDArray[np.float64]:
        """(R,) beam elevations in radians, ring 0 first."""
        return np.radians(np.array(self.elevation_deg, np.float64))

    @property
    def azimuth(self) -> NDArray[np.float64]:
        """(C,) azimuth of each column in radians, column 0 first, from straight ahead, beams' own offsets apart."""
        step = (self.azimuth_end_deg - self.azimuth_start_deg) / self.columns
        degrees = self.azimuth_start_deg + step * np.arange(self.columns)
        return np.radians(self.azimuth_start_deg + self.azimuth_end_deg - degrees if self.clockwise else degrees)

    @property
    def azimuth_offset(self) -> NDArray[np.float64]:
        """(R,) azimuth of each beam beyond that of its column, rad, the head's turning until it fires included."""
        offset = np.radians(np.array(self.azimuth_offset_deg or (0.0,) * self.rings, np.float64))
        if not self.firing_s:
            return offset
        turn = np.radians(self.azimuth_end_deg - self.azimuth_start_deg) * (-1.0 if self.clockwise else 1.0)
        return offset + turn / self.columns * self.firing_share

    @property
    def firing_share(self) -> NDArray[np.float64]:
        """(R,) when each beam fires, as a share of its column, in [0, 1)."""
        if not self.firing_s:
            return np.full(self.rings, 0.5)
        return np.array(self.firing_s, np.float64) * self.columns / self.period_s

    @property
    def beam_range(self) -> NDArray[np.float64]:
        """(R, 2) nearest and farthest range of each beam, m."""
        return np.array(self.beam_range_m or ((self.range_min_m, self.range_max_m),) * self.rings, np.float64)

    @property
    def blocked(self) -> NDArray[np.bool_]:
        """(R, C) beams that the carrier hides."""
        hidden = np.zeros((self.rings, self.columns), bool)
        if self.blocked_deg is not msgspec.UNSET:
            azimuth = np.degrees(self.azimuth + self.azimuth_offset[:, None])
            elevation = np.array(self.elevation_deg)[:, None]
            for start, end, top in self.blocked_deg:
                hidden |= (elevation < top) & ((azimuth - start) % 360.0 < end - start)
        return hidden

    @property
    def period_s(self) -> float:
        """Duration of one sweep, s."""
        return 1.0 / self.rate_hz

    @property
    def column_s(self) -> float:
        """Time from one column to the next, s; 0 without a rolling shutter."""
        return self.period_s / self.columns if self.rolling_shutter else 0.0

    @property
    def time_offset(self) -> NDArray[np.float64]:
        """(R, C) firing times minus the sweep's reference time, s: centred, within half a period."""
        column = np.arange(self.columns) - 0.5 * self.columns
        return (column + self.firing_share[:, None]) * self.column_s


def _check_types(spec: Prism | LidarSpec, name: str) -> None:
    """Convert the fields of a spec to their declared types; SettingsError where impossible."""
    for field, (expected, read) in _readers(type(spec)).items():
        found = getattr(spec, field)
        try:
            value = read(found)
        except (TypeError, ValueError, OverflowError):
            raise SettingsError(complaint(name, field, expected, repr(found).replace("\n", ""))) from None
        msgspec.structs.force_setattr(spec, field, value)


@lru_cache(maxsize=2)
def _readers(kind: type[Prism | LidarSpec]) -> dict[str, tuple[str, Callable[[Any], Any]]]:
    """Return for each field the expected type in words and its converter."""
    return {field.name: _OF_TYPE[field.type] for field in msgspec.structs.fields(kind)}


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise TypeError
    return float(value)


def _whole(value: Any) -> int:
    if not _number(value).is_integer():
        raise ValueError
    return int(value)


def _unless_unset(read: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: value if value is msgspec.UNSET else read(value)


def _exactly(kind: type) -> Callable[[Any], Any]:
    def read(value: object) -> Any:
        if isinstance(value, np.bool_):
            value = bool(value)
        if not isinstance(value, kind):
            raise TypeError
        return value

    return read


def _each(read: Callable[[object], object], length: int | None = None) -> Callable[[Any], tuple[Any, ...]]:
    """Return the converter of a table of values, of a given length or any."""

    def read_all(value: object) -> tuple[Any, ...]:
        rows = value.tolist() if isinstance(value, np.ndarray) else value
        if not isinstance(rows, Sequence) or isinstance(rows, str) or length not in (None, len(rows)):
            raise TypeError
        return tuple(read(row) for row in rows)

    return read_all


_OF_TYPE: dict[Any, tuple[str, Callable[[Any], Any]]] = {
    float: ("a number", _number),
    float | None: ("a number or None", lambda value: None if value is None else _number(value)),
    int: ("a whole number", _whole),
    bool: ("True or False", _exactly(bool)),
    str: ("text", _exactly(str)),
    Returns: (f"one of {get_args(Returns)}", _exactly(str)),
    IntensityLaw: (f"one of {get_args(IntensityLaw)}", _exactly(str)),
    tuple[float, ...]: ("a table of numbers", _each(_number)),
    tuple[float, float, float]: ("three numbers", _each(_number, 3)),
    tuple[tuple[float, float], ...]: ("a table of pairs of numbers", _each(_each(_number, 2))),
    float | msgspec.UnsetType: ("a number", _unless_unset(_number)),
    tuple[float, float] | msgspec.UnsetType: ("two numbers", _unless_unset(_each(_number, 2))),
    tuple[tuple[float, float, float], ...] | msgspec.UnsetType: (
        "a table of triples of numbers",
        _unless_unset(_each(_each(_number, 3))),
    ),
    tuple[tuple[float, float], ...] | msgspec.UnsetType: (
        "a table of pairs of numbers",
        _unless_unset(_each(_each(_number, 2))),
    ),
    tuple[str, ...]: ("a table of texts", _each(_exactly(str))),
    tuple[Prism, ...]: ("a table of Prism", _each(_exactly(Prism))),
}
"""Expected type in words and converter by type of the field."""
