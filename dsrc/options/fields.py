"""Names, choices and types that options share, and the decorator of a function that takes a struct of them."""

from collections.abc import Callable, Sequence
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import Annotated, Any, Concatenate, Literal, ParamSpec, Protocol, TypeVar, get_type_hints, overload

import msgspec
from tyro.conf import Positional, arg

from sim.errors import SettingsError
from sim.settings import renamed

T = TypeVar("T")
Fields = ParamSpec("Fields")
Work = ParamSpec("Work")
Options_contra = TypeVar("Options_contra", contravariant=True)
Options = TypeVar("Options")
Result = TypeVar("Result")
Result_co = TypeVar("Result_co", covariant=True)

Folder = Annotated[Path, arg(metavar="FOLDER")]
File = Annotated[Path, arg(metavar="FILE")]
Data = Positional[Annotated[Path, arg(metavar="DATA")]]
"""Positional argument: a drive, or a folder of drives."""
Scenario = Positional[Annotated[str, arg(metavar="SCENARIO")]]
Splits = Positional[Annotated[str, arg(metavar="SPLITS")]]
Family = Literal["physical", "paper"]
AgentsText = Annotated[str, arg(metavar="{all,ego,helpers,vehicles,roadside,ID[,ID...]}")]
"""Agents whose sweeps are corrupted, see `sensors.corruptions.parse_agents`."""

FaultTexts = Annotated[tuple[str, ...], arg(metavar="FAULT [...]")]
"""Texts of faults, see `dsrc.faults.fault`."""

# Lists of choices for help texts, so that help needs no heavy import; the functions decide, tests compare.
CORRUPTIONS = (
    "beam_missing",
    "motion_blur",
    "fog",
    "snow",
    "crosstalk",
    "cross_sensor",
    "wet_ground",
    "incomplete_echo",
    "rain",
    "spray",
    "pose_error",
    "clock_offset",
    "point_dropping",
    "field_of_view",
    "noise",
)
CHANNELS = ("ideal", "paper", "its-g5-6", "its-g5-27", "c-v2x", "trace:FILE")
RECIPES = ("debug", "small", "opv2v", "dsrc-paper", "dsrc-code")
METHODS = (
    "no-collaboration",
    "early",
    "late",
    "f-cooper",
    "attfuse",
    "max-map",
    "v2vnet",
    "v2x-vit",
    "cobevt",
    "where2comm",
    "coalign",
    "ermvp",
    "mrcnet-style",
    "dsrc",
    "dsrc-max",
    "dsrc-alone",
)


RENAMED = {
    "who": "corrupted_agents",
    "checkpoints": "checkpoint",
    "corruptions": "corruption",
    "severities": "severity",
    "families": "family",
    "channels": "channel",
    "limit": "frames",
}
"""Options by their former names, which command line, TOML and Python take with a warning, see `sim.errors.GOES`."""


def choice(names: Sequence[str], several: bool = False) -> Any:
    """Return the tyro setting of an option whose choices are listed; the function that reads it names the nearest."""
    listed = f"{{{','.join(names)}}}"
    return arg(metavar=f"{listed} [...]" if several else listed)


class Corrupted(msgspec.Struct, frozen=True, kw_only=True):
    """How sweeps are corrupted, beside the kind of corruption.

    Attributes:
        severity: severity of the corruption, 1 to 5.
        family: models of the corruption: of physical causes, or as published in papers.
        corrupted_agents: agents whose sweeps are corrupted, by word or by their ids; weather at some alone is a
            counterfactual: it acts on their sensors and nowhere else.
    """

    severity: int = 3
    family: Family = "physical"
    corrupted_agents: AgentsText = "all"


class Disturbed(Corrupted, frozen=True, kw_only=True):
    """How sweeps are corrupted, and what changes of the radio channels.

    Attributes:
        loss: share of packets lost, 0 to 1, such as 0.3; default: the channel's.
        delay_s: delay of messages, s; default: the channel's.
        pose_error: pose error of the collaborators, m and deg; default: the channel's.
    """

    loss: float | None = None
    delay_s: float | None = None
    pose_error: float | None = None

    def radios(self, channels: Sequence[str]) -> tuple[str, ...]:
        """Return the channels as changed, see `changed_radios`."""
        return changed_radios(channels, self.loss, self.delay_s, self.pose_error)


def changed_radios(
    channels: Sequence[str], loss: float | None, delay_s: float | None, pose_error: float | None
) -> tuple[str, ...]:
    """Return channels with changes, of the ideal one where changes are given alone; as they are without changes."""
    if loss is delay_s is pose_error is None:
        return tuple(channels)
    from sim.radio import IDEAL, Radio

    return tuple(Radio.parse(one).changed(loss, delay_s, pose_error).label for one in channels or (IDEAL,))


class Output(msgspec.Struct, frozen=True, kw_only=True):
    """Treatment of files that are in the way.

    Attributes:
        force: replace files of other programs too; without it only those that dsrc wrote.
    """

    force: bool = False


class TakesFields(Protocol[Options_contra, Fields, Work, Result_co]):
    """Function of a struct of options, or of its fields as arguments."""

    @overload
    def __call__(self, options: Options_contra, /, *args: Work.args, **kwargs: Work.kwargs) -> Result_co: ...
    @overload
    def __call__(self, *args: Fields.args, **kwargs: Fields.kwargs) -> Result_co: ...
    @overload
    def __call__(self, *args: Any, progress: Callable[[int, int], None] | None, **kwargs: Any) -> Result_co: ...


def takes_fields(
    struct: Callable[Fields, Options],
) -> Callable[[Callable[Concatenate[Options, Work], Result]], TakesFields[Options, Fields, Work, Result]]:
    """Return a decorator: a function of a struct takes the struct's fields as arguments of its own too.

    `f(Struct(data, seed=3), progress=report)` and `f(data, seed=3, progress=report)` are the same.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        further = list(signature(function).parameters.values())[1:]
        names = {one.name for one in msgspec.structs.fields(struct)}  # type: ignore[arg-type]

        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            if args and isinstance(args[0], struct):  # type: ignore[arg-type]
                return function(*args, **kwargs)
            work = {one.name: kwargs.pop(one.name) for one in further if one.name in kwargs}
            return function(struct(*args, **renamed(kwargs, RENAMED, names, "", SettingsError)), **work)  # type: ignore[arg-type]

        hints = get_type_hints(struct)
        fields = [one.replace(annotation=hints[name]) for name, one in signature(struct).parameters.items()]
        own = [one.replace(kind=Parameter.KEYWORD_ONLY) for one in further]
        call.__signature__ = signature(function).replace(parameters=[*fields, *own])  # type: ignore[attr-defined]
        return call

    return decorate
