"""Kinds of faults: where each acts, on whom, and by which numbers."""

from dataclasses import dataclass
from math import inf
from typing import ClassVar, Literal

import msgspec

from sensors.corruptions import CORRUPTIONS, DEFAULT_SEVERITY, Changes, Family
from sensors.corruptions.apply import CorruptedAgents

Place = Literal["sensor", "localisation", "radio", "message", "computing", "actuation"]
"""Where a fault acts: on sweeps, on the believed pose, on the delivery of messages, on what a lying helper writes into
them (attacks), on the detector's cycle, on the ego's commands."""

Ranges = dict[str, tuple[float, float]]


class FaultSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Numbers of a fault; the first field is the one that a text may leave unnamed.

    Attributes:
        RANGES: least and largest value of each field; a field without a default must be given.
        ANY: at least one field must be given, whichever.
        IDLE: value of each field with which the fault does nothing, 0 where it is not listed; None for a field that
            says where or how, not how much.
    """

    RANGES: ClassVar[Ranges] = {}
    ANY: ClassVar[bool] = False
    IDLE: ClassVar[dict[str, float | None]] = {}


class Severity(FaultSettings, frozen=True):
    """Severity of a corruption, 1 to 5, and its models; in Python also settings and a preset, see `Condition`."""

    RANGES: ClassVar[Ranges] = {"severity": (1, 5)}
    severity: int = DEFAULT_SEVERITY
    family: Family = "physical"
    changes: Changes = ()
    preset: str | None = None


class Share(FaultSettings, frozen=True):
    """Share of what is lost, 0 to 1."""

    RANGES: ClassVar[Ranges] = {"share": (0.0, 1.0)}
    share: float


class Seconds(FaultSettings, frozen=True):
    """Time, s."""

    RANGES: ClassVar[Ranges] = {"seconds": (0.0, inf)}
    seconds: float


class Bursts(FaultSettings, frozen=True):
    """Share of the time in which a link is down, and the mean length of a burst, s."""

    RANGES: ClassVar[Ranges] = {"share": (0.0, 0.99), "mean_s": (0.01, inf)}
    share: float
    mean_s: float = 0.5


class Rate(FaultSettings, frozen=True):
    """Largest rate of messages, Hz."""

    RANGES: ClassVar[Ranges] = {"hz": (0.01, inf)}
    IDLE: ClassVar[dict[str, float | None]] = {"hz": inf}
    hz: float


class Reach(FaultSettings, frozen=True):
    """Largest distance at which messages arrive, m."""

    RANGES: ClassVar[Ranges] = {"metres": (0.1, inf)}
    IDLE: ClassVar[dict[str, float | None]] = {"metres": inf}
    metres: float


class Age(FaultSettings, frozen=True):
    """Largest age at which a message is used, s."""

    RANGES: ClassVar[Ranges] = {"seconds": (0.01, inf)}
    IDLE: ClassVar[dict[str, float | None]] = {"seconds": inf}
    seconds: float


class Freeze(FaultSettings, frozen=True):
    """No number: a sensor repeats its last sweep."""


class Blocked(FaultSettings, frozen=True):
    """Part of the field that is covered, degrees, about a direction counter-clockwise from ahead."""

    RANGES: ClassVar[Ranges] = {"width_deg": (0.0, 360.0), "middle_deg": (-360.0, 360.0)}
    IDLE: ClassVar[dict[str, float | None]] = {"middle_deg": None}
    width_deg: float
    middle_deg: float = 0.0


class Dirt(FaultSettings, frozen=True):
    """Share of the field that spots of dirt cover in the end, and the time in which they grow from none, s."""

    RANGES: ClassVar[Ranges] = {"share": (0.0, 1.0), "growth_s": (0.0, inf)}
    IDLE: ClassVar[dict[str, float | None]] = {"growth_s": inf}
    share: float
    growth_s: float = 5.0


class Misalignment(FaultSettings, frozen=True):
    """Turn and place of a sensor against its calibration, degrees and cm, in its own frame."""

    RANGES: ClassVar[Ranges] = dict.fromkeys(("yaw_deg", "pitch_deg", "roll_deg"), (-180.0, 180.0)) | dict.fromkeys(
        ("ahead_cm", "aside_cm", "up_cm"), (-1e4, 1e4)
    )
    ANY: ClassVar[bool] = True
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    ahead_cm: float = 0.0
    aside_cm: float = 0.0
    up_cm: float = 0.0


class Size(FaultSettings, frozen=True):
    """Standard deviation of each error of a pose, m and degrees."""

    RANGES: ClassVar[Ranges] = {"size": (0.0, inf)}
    size: float


class Bias(FaultSettings, frozen=True):
    """Error of a pose, m ahead and to the left, degrees counter-clockwise."""

    ANY: ClassVar[bool] = True
    ahead_m: float = 0.0
    aside_m: float = 0.0
    turn_deg: float = 0.0


class Drift(FaultSettings, frozen=True):
    """Error of a pose that grows from 0, m/s ahead and to the left, degrees/s counter-clockwise."""

    ANY: ClassVar[bool] = True
    ahead_mps: float = 0.0
    aside_mps: float = 0.0
    turn_deg_s: float = 0.0


class Gain(FaultSettings, frozen=True):
    """Factor."""

    RANGES: ClassVar[Ranges] = {"factor": (0.0, 10.0)}
    IDLE: ClassVar[dict[str, float | None]] = {"factor": 1.0}
    factor: float


class Ghost(FaultSettings, frozen=True):
    """Share of the messages that tell of a standing car that is not there, so far ahead of the ego on its route, m."""

    RANGES: ClassVar[Ranges] = {"share": (0.0, 1.0), "ahead_m": (3.0, 150.0)}
    IDLE: ClassVar[dict[str, float | None]] = {"ahead_m": None}
    share: float = 1.0
    ahead_m: float = 25.0


class Remove(FaultSettings, frozen=True):
    """Share of the messages that say nothing of the road users within a distance of the ego's route, m."""

    RANGES: ClassVar[Ranges] = {"share": (0.0, 1.0), "aside_m": (0.0, inf)}
    share: float = 1.0
    aside_m: float = 100.0


@dataclass(frozen=True, slots=True)
class FaultKind:
    """One kind of fault.

    Attributes:
        place: where it acts.
        settings: its numbers.
        agents: on whom it acts where a text names nobody; with `helpers` or `ego` on nobody else.
        radio: change of the channel that each of its numbers is, by a key of `sim.radio.CHANGES`.
    """

    place: Place
    settings: type[FaultSettings]
    agents: CorruptedAgents = "all"
    radio: tuple[str, ...] = ()


REPLAY = "replay"
"""Attack that needs the messages before the one that it changes: boxes are kept, clouds are not."""
KINDS: dict[str, FaultKind] = {
    "frame_drop": FaultKind("sensor", Share),
    "freeze": FaultKind("sensor", Freeze),
    "blocked": FaultKind("sensor", Blocked),
    "dirt": FaultKind("sensor", Dirt),
    "misalignment": FaultKind("sensor", Misalignment),
    "localisation_noise": FaultKind("localisation", Size, "all", ("pose_error",)),
    "localisation_bias": FaultKind("localisation", Bias),
    "localisation_drift": FaultKind("localisation", Drift),
    "speed_reading": FaultKind("localisation", Gain, "ego"),
    "loss": FaultKind("radio", Share, "helpers", ("loss",)),
    "unequipped": FaultKind("radio", Share, "helpers", ("unequipped",)),
    "bursts": FaultKind("radio", Bursts, "helpers", ("burst_loss", "burst_s")),
    "delay": FaultKind("radio", Seconds, "helpers", ("delay_s",)),
    "jitter": FaultKind("radio", Seconds, "helpers", ("jitter_s",)),
    "rate": FaultKind("radio", Rate, "helpers", ("message_hz",)),
    "range": FaultKind("radio", Reach, "helpers", ("range_m",)),
    "age": FaultKind("radio", Age, "helpers", ("longest_age_s",)),
    "ghost": FaultKind("message", Ghost, "helpers"),
    "remove": FaultKind("message", Remove, "helpers"),
    "false_pose": FaultKind("message", Bias, "helpers"),
    REPLAY: FaultKind("message", Seconds, "helpers"),
    "latency": FaultKind("computing", Seconds, "ego"),
    "missed_cycles": FaultKind("computing", Share, "ego"),
    "control_delay": FaultKind("actuation", Seconds, "ego"),
    "control_lag": FaultKind("actuation", Seconds, "ego"),
    "control_drop": FaultKind("actuation", Share, "ego"),
    "brake_gain": FaultKind("actuation", Gain, "ego"),
    "steering_gain": FaultKind("actuation", Gain, "ego"),
}
"""Kinds beside the corruptions, by name."""

CORRUPTION = FaultKind("sensor", Severity)
"""Kind of every corruption."""


def kind_names() -> tuple[str, ...]:
    """Return the names of all kinds, corruptions first."""
    return (*CORRUPTIONS, *KINDS)
