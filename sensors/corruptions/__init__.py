"""Corruptions: what weather and faults do to a sweep.

Two families of settings, never mixed: `physical`, modules of this package, one per physical cause, is the default;
`paper`, modules of `sensors.corruptions.published`, one per published model, computes what was published, to compare with
its tables. Not every kind has a published model. Those models know no time: they draw anew for every frame.

Weather is shared: all agents of a frame are in the same fog, whose strength drifts slowly over a drive (`weather`).
Faults are each sensor's own. Streams of randomness, children of the drive's seed by spawn key:

| key                                       | what                                                  |
|-------------------------------------------|-------------------------------------------------------|
| (2, crc32 of kind, 1 + frame, agent)      | one agent's sweep in one frame                        |
| (2, crc32 of kind, 0, agent)              | a fault that stays for a drive (`Corruption.steady`)  |
| (3, crc32 of kind, 0)                     | drift of a weather's strength over a drive            |
| (3, crc32 of kind, 1)                     | what the weather of a drive is made of: its patches   |
| (4, crc32 of the drive's name)            | seed of one of many drives (`drive_seed`)             |

(agent modulo 2^32). A corruption draws the same numbers at every severity, wherever that can be.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Protocol, Self, cast, get_args

import numpy as np

from sensors.corruptions import (
    beam_missing,
    clock_offset,
    cross_sensor,
    crosstalk,
    field_of_view,
    fog,
    incomplete_echo,
    motion_blur,
    noise,
    point_dropping,
    pose_error,
    rain,
    snow,
    spray,
    wet_ground,
)
from sensors.corruptions.physics.levels import PAPER, SEVERITIES, check_severity
from sensors.corruptions.physics.weather import strength, weather_rng
from sensors.corruptions.published import beams as paper_beams
from sensors.corruptions.published import fog as paper_fog
from sensors.corruptions.published import incomplete_echo as paper_incomplete_echo
from sensors.corruptions.published import points as paper_points
from sensors.corruptions.published import rain as paper_rain
from sensors.corruptions.published import snow as paper_snow
from sensors.corruptions.published import wet_ground as paper_wet_ground
from sensors.frame import AgentFrame, Frame
from sensors.sweep import ADDED, Sweep
from sim.errors import DataError, SettingsError, complaint, did_you_mean

__all__ = [
    "CLEAN",
    "CORRUPTIONS",
    "FAMILIES",
    "PAPER",
    "PAPER_SIX",
    "SEVERITIES",
    "Corruption",
    "Family",
    "check_corruption",
    "check_family",
    "corrupt",
    "corrupt_frame",
    "corruption_rng",
    "drive_seed",
    "kinds_of",
]

CLEAN = "clean"
"""The kind that changes nothing."""

Family = Literal["physical", "paper"]
FAMILIES: tuple[Family, ...] = get_args(Family)

Level = Literal["sweep", "frame"]

_STREAM, _DRIVE_STREAM = 2, 4


class Settings(Protocol):
    """Parameters of a corruption: a frozen struct."""

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        ...


class Weather(Settings, Protocol):
    """Parameters of a kind of weather."""

    def scaled(self, factor: float) -> Self:
        """Return the settings of weather so many times as strong."""
        ...


Apply = Callable[..., Sweep]


@dataclass(frozen=True, slots=True)
class Corruption:
    """One kind of corruption.

    Attributes:
        settings: its physical parameters; the defaults are those of severity 3.
        apply: `apply(sweep, settings, rng) -> Sweep`, never in place; None for a kind that a sweep alone cannot know.
        in_frame: `in_frame(frame, row, settings, rng) -> Sweep`, the same for the agent in a row of a frame, where the
            frame tells more than the sweep: time, motion, other actors. None where it does not. For weather `rng` is
            the drive's, the same for every agent and frame; else the agent's.
        paper_settings: parameters of the published model, None where there is none.
        paper_apply: the published model, as `apply`.
        steady: what it draws stays the same over a drive.
        weather: shared by all agents, and drifting.
        spares_ego: the ego is left as it is: the corruption is an error relative to it.
    """

    settings: type[Settings]
    apply: Apply | None = None
    in_frame: Apply | None = None
    paper_settings: type[Settings] | None = None
    paper_apply: Apply | None = None
    steady: bool = False
    weather: bool = False
    spares_ego: bool = False

    @property
    def level(self) -> Level:
        """What it takes: a sweep, or a whole frame."""
        return "frame" if self.apply is None else "sweep"

    def settings_of(self, family: Family) -> type[Settings]:
        """Return the settings of a family; KeyError when it has no model of this kind."""
        if family == "physical":
            return self.settings
        if self.paper_settings is None:
            raise KeyError(family)
        return self.paper_settings


CORRUPTIONS: dict[str, Corruption] = {
    "beam_missing": Corruption(
        beam_missing.BeamMissing,
        beam_missing.corrupt,
        paper_settings=paper_beams.BeamMissing,
        paper_apply=paper_beams.beam_missing,
        steady=True,
    ),
    "motion_blur": Corruption(
        motion_blur.MotionBlur,
        motion_blur.corrupt,
        motion_blur.in_frame,
        paper_settings=paper_points.MotionBlur,
        paper_apply=paper_points.motion_blur,
    ),
    "fog": Corruption(fog.Fog, fog.corrupt, paper_settings=paper_fog.Fog, paper_apply=paper_fog.corrupt, weather=True),
    "snow": Corruption(
        snow.Snow, snow.corrupt, paper_settings=paper_snow.Snow, paper_apply=paper_snow.corrupt, weather=True
    ),
    "crosstalk": Corruption(
        crosstalk.Crosstalk,
        crosstalk.corrupt,
        paper_settings=paper_points.Crosstalk,
        paper_apply=paper_points.crosstalk,
    ),
    "cross_sensor": Corruption(
        cross_sensor.CrossSensor,
        cross_sensor.corrupt,
        paper_settings=paper_beams.CrossSensor,
        paper_apply=paper_beams.cross_sensor,
    ),
    "wet_ground": Corruption(
        wet_ground.WetGround,
        wet_ground.corrupt,
        paper_settings=paper_wet_ground.WetGround,
        paper_apply=paper_wet_ground.corrupt,
        weather=True,
    ),
    "incomplete_echo": Corruption(
        incomplete_echo.IncompleteEcho,
        incomplete_echo.corrupt,
        incomplete_echo.in_frame,
        paper_settings=paper_incomplete_echo.IncompleteEcho,
        paper_apply=paper_incomplete_echo.corrupt,
    ),
    "rain": Corruption(
        rain.Rain, rain.corrupt, paper_settings=paper_rain.Rain, paper_apply=paper_rain.corrupt, weather=True
    ),
    "spray": Corruption(spray.Spray, in_frame=spray.corrupt, weather=True),
    "pose_error": Corruption(pose_error.PoseError, in_frame=pose_error.in_frame, steady=True, spares_ego=True),
    "clock_offset": Corruption(clock_offset.ClockOffset, in_frame=clock_offset.in_frame, steady=True, spares_ego=True),
    "point_dropping": Corruption(
        point_dropping.PointDropping,
        point_dropping.corrupt,
        paper_settings=paper_points.PointDropping,
        paper_apply=paper_points.point_dropping,
    ),
    "field_of_view": Corruption(
        field_of_view.FieldOfView,
        field_of_view.corrupt,
        paper_settings=paper_points.FieldOfView,
        paper_apply=paper_points.field_of_view,
        steady=True,
    ),
    "noise": Corruption(noise.Noise, noise.corrupt, paper_settings=paper_points.Noise, paper_apply=paper_points.noise),
}
"""Every corruption by its name."""

PAPER_SIX = ("beam_missing", "motion_blur", "fog", "snow", "crosstalk", "cross_sensor")
"""The six corruptions of the DSRC paper's tables, in its order."""


def kinds_of(family: Family = "physical") -> tuple[str, ...]:
    """Return the kinds that a family has a model of, in the order of `CORRUPTIONS`."""
    return tuple(kind for kind, c in CORRUPTIONS.items() if family == "physical" or c.paper_apply is not None)


def corrupt(sweep: Sweep, kind: str, severity: int, rng: np.random.Generator, family: Family = "physical") -> Sweep:
    """Return the sweep as the sensor would have delivered it under a corruption, with the points that it lost counted.

    Args:
        sweep: as measured.
        kind: key of `CORRUPTIONS`, or `clean`.
        severity: 1 to 5; 3 is the paper's.
        rng: the only randomness.
        family: of the settings.

    Raises:
        SettingsError: an unknown kind, severity or family, or a kind that acts on frames: see `corrupt_frame`.
        DataError: the sweep does not say what the corruption needs, such as its rings, or its points are no points.
    """
    check_corruption(kind, severity, family)
    if kind == CLEAN:
        return sweep
    _check_points(sweep)
    corruption = CORRUPTIONS[kind]
    apply = corruption.apply if family == "physical" else corruption.paper_apply
    if apply is None:
        raise SettingsError(f"corruption '{kind}' acts on whole frames: use corrupt_frame")
    return _counted(sweep, apply(sweep, corruption.settings_of(family).severity(severity), rng))


def corrupt_frame(
    frame: Frame,
    kind: str,
    severity: int,
    seed: int,
    family: Family = "physical",
    *,
    ego_id: int | None = None,
) -> Frame:
    """Corrupt the sweeps of all agents of a frame; ground truth and its point counts stay.

    Args:
        frame: as recorded.
        kind: key of `CORRUPTIONS`, or `clean`.
        severity: 1 to 5.
        seed: of the drive's corruption; frames may be corrupted in any order.
        family: of the settings.
        ego_id: the agent that errors of pose and clock are relative to; None takes the first vehicle in the order of
            the folders, else the first agent. No other kind minds who it is.

    Raises:
        SettingsError: an unknown kind, severity or family.
        DataError: a sweep does not say what the corruption needs, or its points are no points; the message names the
            agent.
    """
    check_corruption(kind, severity, family)
    if kind == CLEAN:
        return frame
    corruption = CORRUPTIONS[kind]
    settings = corruption.settings_of(family).severity(severity)
    if corruption.weather and family == "physical":
        settings = cast(Weather, settings).scaled(strength(seed, kind, frame.time_s))
    shared = corruption.weather and corruption.in_frame is not None and family == "physical"
    spared = _ego_row(frame.agents, ego_id) if corruption.spares_ego else -1
    sweeps = []
    for row, agent in enumerate(frame.agents):
        if row == spared:
            sweeps.append(agent.sweep)
            continue
        own = corruption_rng(seed, kind, frame.index, agent.agent_id, family)
        rng = weather_rng(seed, kind) if shared else own
        try:
            _check_points(agent.sweep)
            sweeps.append(_counted(agent.sweep, _applied(corruption, family, frame, row, settings, rng)))
        except DataError as error:
            raise DataError(f"frame {frame.index}: agent {agent.agent_id}: {error}") from None
    return frame.with_sweeps(sweeps)


def corruption_rng(seed: int, kind: str, index: int, agent_id: int, family: Family = "physical") -> np.random.Generator:
    """Return the stream of one agent's sweep in one frame."""
    when = 0 if CORRUPTIONS[kind].steady and family == "physical" else 1 + index
    key = (_STREAM, zlib.crc32(kind.encode()), when, agent_id % 2**32)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def drive_seed(seed: int, drive: str) -> int:
    """Return the seed of a drive among many of one run, by its name: each has weather and faults of its own."""
    key = (_DRIVE_STREAM, zlib.crc32(drive.encode()))
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0])


def check_corruption(kind: str, severity: int = PAPER, family: str = "physical") -> None:
    """Raise SettingsError unless this kind, or `clean`, is in this family and this severity exists."""
    check_family(family)
    if kind != CLEAN and kind not in CORRUPTIONS:
        raise SettingsError(f"unknown corruption '{kind}'{did_you_mean(kind, [CLEAN, *CORRUPTIONS])}")
    if kind != CLEAN and family == "paper" and CORRUPTIONS[kind].paper_apply is None:
        raise SettingsError(
            f"corruption '{kind}' has no published model; family 'paper' has {', '.join(kinds_of('paper'))}"
        )
    check_severity(severity)


def check_family(family: str) -> None:
    """Raise SettingsError unless this is one of `FAMILIES`."""
    if family not in FAMILIES:
        raise SettingsError(f"unknown family of corruptions '{family}'{did_you_mean(family, FAMILIES)}")


def _check_points(sweep: Sweep) -> None:
    """Raise DataError unless coordinates are finite and intensities in [0, 1]: from 8 bits every target is blinding."""
    if len(sweep) == 0:
        return
    if not np.isfinite(sweep.points).all():
        bad = int(np.count_nonzero(~np.isfinite(sweep.points).all(axis=1)))
        raise DataError(complaint("sweep", "points", "finite coordinates", f"nan or inf in {bad} of {len(sweep)}"))
    low, high = float(sweep.intensity.min()), float(sweep.intensity.max())
    if not (low >= 0.0 and high <= 1.0):
        expected = "0 to 1 (divide those of 8 bits by 255)"
        raise DataError(complaint("sweep", "intensity", expected, f"{low:g} to {high:g}"))


def _applied(
    corruption: Corruption, family: Family, frame: Frame, row: int, settings: Settings, rng: np.random.Generator
) -> Sweep:
    """Return the sweep of the agent in a row of the frame by the model of the family that knows most."""
    if family == "physical" and corruption.in_frame is not None:
        return corruption.in_frame(frame, row, settings, rng)
    apply = corruption.apply if family == "physical" else corruption.paper_apply
    if apply is None:
        raise KeyError(family)
    return apply(frame.agents[row].sweep, settings, rng)


def _counted(before: Sweep, after: Sweep) -> Sweep:
    """Return the corrupted sweep with the points of surfaces that it lacks counted in `lost`."""
    lost = before.lost + max(0, _real(before) - _real(after))
    return after if after.lost == lost else replace(after, lost=lost)


def _real(sweep: Sweep) -> int:
    """Return the number of points that a surface returned."""
    return int(np.count_nonzero(sweep.object_id != ADDED))


def _ego_row(agents: tuple[AgentFrame, ...], ego_id: int | None) -> int:
    """Return the row of the ego; -1 when there is no such agent."""
    if ego_id is None:
        return next((row for row, agent in enumerate(agents) if agent.kind == "vehicle"), 0)
    return next((row for row, agent in enumerate(agents) if agent.agent_id == ego_id), -1)
