"""Registry of corruptions by kind: built-in ones, entry points of other packages, and those a program registers.

An entry point of the group `dsrc.corruptions` names a `Corruption`,

    [project.entry-points."dsrc.corruptions"]
    haze = "my_package.haze:HAZE"

and is imported when `haze` is first used: by any command and in every worker process.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, get_args

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
from sensors.corruptions.physics.levels import DEFAULT_SEVERITY, SEVERITIES, at_level, require_severity
from sensors.corruptions.published import beams as paper_beams
from sensors.corruptions.published import fog as paper_fog
from sensors.corruptions.published import incomplete_echo as paper_incomplete_echo
from sensors.corruptions.published import points as paper_points
from sensors.corruptions.published import rain as paper_rain
from sensors.corruptions.published import snow as paper_snow
from sensors.corruptions.published import wet_ground as paper_wet_ground
from sensors.sweep import Sweep
from sim.catalog.registry import Registry, import_path, instance_of
from sim.errors import SettingsError, complaint, did_you_mean

CLEAN = "clean"
"""The kind that changes nothing."""

Family = Literal["physical", "paper"]
FAMILIES: tuple[Family, ...] = get_args(Family)

Level = Literal["sweep", "frame"]

Apply = Callable[..., Sweep]

_RESERVED = (CLEAN, "all", "paper_six")
_NAME = re.compile(r"[a-z][a-z0-9_]*")


class SeverityTable(Protocol):
    """Settings of each severity: a class of settings, or `SettingsList`."""

    def severity(self, level: int, /) -> Any:
        """Return the settings of a severity, 1 to 5; those of weather have `scaled(factor)`."""
        ...


@dataclass(frozen=True, slots=True)
class SettingsList:
    """Five settings, those of severities 1 to 5."""

    levels: tuple[Any, ...]

    def severity(self, level: int) -> Any:
        """Return the settings of a severity, 1 to 5."""
        return at_level(self.levels, level)


@dataclass(frozen=True, slots=True)
class Corruption:
    """One kind of corruption.

    Attributes:
        settings: physical parameters by severity; the defaults of the built-in classes are those of severity 3.
        apply: `apply(sweep, settings, rng) -> Sweep`, never in place; None for a kind that needs the whole frame.
        in_frame: `in_frame(frame, row, settings, rng) -> Sweep`, the same for the agent in a row of a frame, where
            time, motion or other actors matter; else None. For weather `rng` is the drive's, the same for every agent
            and frame; else the agent's.
        paper_settings: parameters of the published model by severity, None where there is none.
        paper_apply: the published model, as `apply`.
        paper_in_frame: the published model, as `in_frame`; else None.
        steady: its draws stay the same over a drive.
        weather: shared by all agents, and drifting.
        spares_ego: the ego keeps its sweep: the corruption is an error relative to it.
        of_objects: acts on objects, or by them: nothing happens to points of which none is known to be on one.
    """

    settings: SeverityTable
    apply: Apply | None = None
    in_frame: Apply | None = None
    paper_settings: SeverityTable | None = None
    paper_apply: Apply | None = None
    paper_in_frame: Apply | None = None
    steady: bool = False
    weather: bool = False
    spares_ego: bool = False
    of_objects: bool = False

    @property
    def level(self) -> Level:
        """Argument of the corruption: a sweep, or a whole frame."""
        return "frame" if self.apply is None else "sweep"

    def settings_of(self, family: Family) -> SeverityTable:
        """Return the settings of a family; KeyError when it has no model of this kind."""
        if family == "physical":
            return self.settings
        if self.paper_settings is None:
            raise KeyError(family)
        return self.paper_settings


CORRUPTIONS: Registry[Corruption] = Registry(
    "dsrc.corruptions",
    {
        "beam_missing": Corruption(
            beam_missing.BeamMissing,
            beam_missing.corrupt,
            paper_settings=paper_beams.PaperBeamMissing,
            paper_apply=paper_beams.beam_missing,
            steady=True,
        ),
        "motion_blur": Corruption(
            motion_blur.MotionBlur,
            motion_blur.corrupt,
            motion_blur.in_frame,
            paper_settings=paper_points.PaperMotionBlur,
            paper_apply=paper_points.motion_blur,
        ),
        "fog": Corruption(
            fog.Fog, fog.corrupt, paper_settings=paper_fog.PaperFog, paper_apply=paper_fog.corrupt, weather=True
        ),
        "snow": Corruption(
            snow.Snow, snow.corrupt, paper_settings=paper_snow.PaperSnow, paper_apply=paper_snow.corrupt, weather=True
        ),
        "crosstalk": Corruption(
            crosstalk.Crosstalk,
            crosstalk.corrupt,
            paper_settings=paper_points.PaperCrosstalk,
            paper_apply=paper_points.crosstalk,
        ),
        "cross_sensor": Corruption(
            cross_sensor.CrossSensor,
            cross_sensor.corrupt,
            paper_settings=paper_beams.PaperCrossSensor,
            paper_apply=paper_beams.cross_sensor,
        ),
        "wet_ground": Corruption(
            wet_ground.WetGround,
            wet_ground.corrupt,
            paper_settings=paper_wet_ground.PaperWetGround,
            paper_apply=paper_wet_ground.corrupt,
            weather=True,
        ),
        "incomplete_echo": Corruption(
            incomplete_echo.IncompleteEcho,
            incomplete_echo.corrupt,
            incomplete_echo.in_frame,
            paper_settings=paper_incomplete_echo.PaperIncompleteEcho,
            paper_apply=paper_incomplete_echo.corrupt,
            paper_in_frame=paper_incomplete_echo.in_frame,
            of_objects=True,
        ),
        "rain": Corruption(
            rain.Rain, rain.corrupt, paper_settings=paper_rain.PaperRain, paper_apply=paper_rain.corrupt, weather=True
        ),
        "spray": Corruption(spray.Spray, in_frame=spray.corrupt, weather=True, of_objects=True),
        "pose_error": Corruption(pose_error.PoseError, in_frame=pose_error.in_frame, steady=True, spares_ego=True),
        "clock_offset": Corruption(
            clock_offset.ClockOffset, in_frame=clock_offset.in_frame, steady=True, spares_ego=True
        ),
        "point_dropping": Corruption(point_dropping.PointDropping, point_dropping.corrupt),
        "field_of_view": Corruption(field_of_view.FieldOfView, field_of_view.corrupt, steady=True),
        "noise": Corruption(noise.Noise, noise.corrupt),
    },
    instance_of(Corruption),
    key=lambda corruption: import_path(corruption.apply or corruption.in_frame),
)
"""Every corruption by its kind."""

PAPER_SIX = ("beam_missing", "motion_blur", "fog", "snow", "crosstalk", "cross_sensor")
"""The six corruptions of the DSRC paper's tables, in its order."""


def register_corruption(
    name: str,
    settings: SeverityTable | Sequence[object],
    apply: Apply | None = None,
    *,
    in_frame: Apply | None = None,
    family: Family = "physical",
    steady: bool = False,
    weather: bool = False,
    spares_ego: bool = False,
) -> Corruption:
    """Add a corruption by name, for this process; `check_corruption` tests it.

    Worker processes and commands find it by an entry point of the group `dsrc.corruptions`.

    Args:
        name: kind, in lower case with underscores.
        settings: five settings, of severities 1 to 5, or a class with `severity(level)`. Settings are builtins or
            `msgspec` structs: datasets store them. Settings of weather have `scaled(factor)`.
        apply: `apply(sweep, settings, rng) -> Sweep`.
        in_frame, steady, weather, spares_ego: see `Corruption`.
        family: `paper` adds a published model to a kind that has a physical one.

    Raises:
        SettingsError: the name is taken or invalid, there are not five settings, or no function.
    """
    require_family(family)
    where = f"register_corruption: {name}"
    if not _NAME.fullmatch(name) or name in _RESERVED:
        raise SettingsError(complaint(where, "name", "lower case with underscores, not reserved", name))
    if apply is None and (in_frame is None or family == "paper"):
        raise SettingsError(complaint(where, "apply", "a function of a sweep or, by in_frame, of a frame", None))
    table = settings if hasattr(settings, "severity") else SettingsList(tuple(settings))
    if isinstance(table, SettingsList) and len(table.levels) != len(SEVERITIES):
        raise SettingsError(complaint(where, "settings", "5, of severities 1 to 5", f"{len(table.levels)}"))
    if weather and not all(hasattr(table.severity(level), "scaled") for level in SEVERITIES):
        raise SettingsError(complaint(where, "settings", "those of weather to have scaled(factor)", "none"))
    if family == "paper":
        known = CORRUPTIONS.get(name)
        if known is None or import_path(known.paper_apply or apply) != import_path(apply):
            expected = "a physical kind without a published model"
            raise SettingsError(complaint(where, "name", expected, name))
        made = replace(known, paper_settings=table, paper_apply=apply)
    else:
        made = Corruption(table, apply, in_frame, steady=steady, weather=weather, spares_ego=spares_ego)
    CORRUPTIONS.register(name, made)
    return made


def kinds_of(family: Family = "physical") -> tuple[str, ...]:
    """Return the kinds that a family has a model of, in the order of `CORRUPTIONS`."""
    return tuple(kind for kind in CORRUPTIONS if family == "physical" or CORRUPTIONS[kind].paper_apply is not None)


def require_corruption(kind: str, severity: int = DEFAULT_SEVERITY, family: str = "physical") -> None:
    """Raise SettingsError unless this kind, or `clean`, is in this family and this severity exists."""
    require_family(family)
    if kind != CLEAN and kind not in CORRUPTIONS:
        raise SettingsError(f"unknown corruption '{kind}'{did_you_mean(kind, [CLEAN, *CORRUPTIONS])}")
    if kind != CLEAN and family == "paper" and CORRUPTIONS[kind].paper_apply is None:
        raise SettingsError(
            f"corruption '{kind}' has no published model; family 'paper' has {', '.join(kinds_of('paper'))}"
        )
    require_severity(severity)


def require_family(family: str) -> None:
    """Raise SettingsError unless this is one of `FAMILIES`."""
    if family not in FAMILIES:
        raise SettingsError(f"unknown family of corruptions '{family}'{did_you_mean(family, FAMILIES)}")
