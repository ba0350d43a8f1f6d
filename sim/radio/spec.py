"""Settings of radio channels: presets by name."""

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from sim.errors import SettingsError, complaint, did_you_mean
from sim.files import file_sha256
from sim.radio.trace import read_trace
from sim.scenario import NonNegative, Positive

IDEAL = "ideal"
HEARING_M = 500.0
"""Carrier sense range: agents within it count for the channel load, m."""


_LATER = ("unequipped", "burst_loss", "burst_s", "jitter_s", "message_hz", "longest_age_s")
"""Settings that channels once had not."""


class Obstruction(IntEnum):
    """Obstruction of the line of sight between two antennas."""

    FREE = 0
    VEHICLE = 1
    BUILDING = 2


class ChannelSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of a radio channel.

    Attributes:
        name: name of the preset.
        medium: `perfect`: everything arrives at once; `fixed`: everything arrives after `delay_s`; `csma`: IEEE
            802.11p and similar; `sps`: LTE sidelink with semi-persistent scheduling; `trace`: from a file.
        range_m: largest range, m.
        environment: environment of the path loss.
        rate_mbps: data rate of a packet, Mb/s.
        snr_db: required signal-to-noise ratio.
        power_dbm: radiated power, antenna gains included.
        noise_dbm: noise power in the band, noise figure included.
        packet_bytes: payload of a packet.
        congestion_control: reactive, as in ETSI TS 102 687.
        collision_share: share of packets lost by collisions at full load.
        packet_loss: probability of packet loss for any other reason.
        message_bytes: size of every message; None: the payload's own size.
        compression: compression ratio of the detector's features.
        delay_s: latency from measurement to sending: processing, and the backbone of infrastructure.
        period_s: reservation period of `sps`.
        position_error_m: standard deviation of a sender's own position, longitudinal and lateral, m.
        heading_error_deg: standard deviation of its heading, degrees.
        error_correlation_s: correlation time of the pose error; 0: independent in every instant.
        clock_error_s: standard deviation of the senders' clocks, s.
        trace: CSV file of `trace`.
        unequipped: share of the agents that have no radio for the whole drive, 1 less the penetration rate.
        burst_loss: share of the time in which a link is down and loses all packets.
        burst_s: mean length of such a burst, s.
        jitter_s: mean of a further delay of each message, exponentially distributed, s.
        message_hz: largest rate at which a sender sends; None: at every instant.
        longest_age_s: age up to which a message is used, s; None: any.
    """

    name: str
    medium: Literal["perfect", "fixed", "csma", "sps", "trace"]
    range_m: Positive = 70.0
    environment: Literal["urban", "highway"] = "urban"
    rate_mbps: Positive = 6.0
    snr_db: float = 8.0
    power_dbm: float = 23.0
    noise_dbm: float = -95.0
    packet_bytes: Annotated[int, Meta(ge=1)] = 1400
    congestion_control: bool = False
    collision_share: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    packet_loss: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    message_bytes: Annotated[int, Meta(ge=1)] | None = None
    compression: Annotated[float, Meta(ge=1.0)] = 1.0
    delay_s: NonNegative = 0.0
    period_s: Positive = 0.1
    position_error_m: NonNegative = 0.0
    heading_error_deg: NonNegative = 0.0
    error_correlation_s: NonNegative = 0.0
    clock_error_s: NonNegative = 0.0
    trace: str = ""
    unequipped: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    burst_loss: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.0
    burst_s: Positive = 0.5
    jitter_s: NonNegative = 0.0
    message_hz: Positive | None = None
    longest_age_s: Positive | None = None

    def decisive(self) -> dict[str, Any]:
        """Return what decides the deliveries, of plain values: parts of keys; of a trace the hash of its file."""
        settings = msgspec.to_builtins(self)
        del settings["name"]
        for one in msgspec.structs.fields(self):
            if one.name in _LATER and settings[one.name] == one.default:  # keys of kept results stay
                del settings[one.name]
        return {**settings, "trace": file_sha256(Path(self.trace))} if self.trace else settings


_RADIO = ChannelSpec(
    name="radio",
    medium="csma",
    range_m=HEARING_M,
    collision_share=0.1,
    compression=128.0,
    delay_s=0.05,
    position_error_m=0.2,
    heading_error_deg=0.2,
    error_correlation_s=30.0,
    clock_error_s=0.005,
)
"""Common settings of the radio presets. Assumed: required SNR, processing time, share of collisions, and a compression
that brings the features of the paper's grid to OpenCOOD's size."""

PRESETS: dict[str, ChannelSpec] = {
    spec.name: spec
    for spec in (
        ChannelSpec(name=IDEAL, medium="perfect"),
        # OpenCOOD's numbers: 70 m, 100 ms, 27 Mb/s, 1.06 Mb of features, white noise of 0.2 m and 0.2 degrees.
        ChannelSpec(
            name="paper",
            medium="fixed",
            rate_mbps=27.0,
            message_bytes=132_500,
            delay_s=0.1,
            position_error_m=0.2,
            heading_error_deg=0.2,
        ),
        # ITS-G5 in 10 MHz: the rate of most messages, and the highest.
        replace(_RADIO, name="its-g5-6", rate_mbps=6.0, snr_db=8.0, congestion_control=True),
        replace(_RADIO, name="its-g5-27", rate_mbps=27.0, snr_db=25.0, congestion_control=True),
        # LTE sidelink, mode 4. Rate and SNR of 16-QAM in 10 MHz are assumed.
        replace(_RADIO, name="c-v2x", medium="sps", rate_mbps=8.8, snr_db=10.0),
        ChannelSpec(name="trace", medium="trace", range_m=HEARING_M),
    )
}


CHANGES: dict[str, tuple[tuple[str, ...], float, float]] = {
    "loss": (("packet_loss",), 0.0, 1.0),
    "delay_s": (("delay_s",), 0.0, inf),
    "pose_error": (("position_error_m", "heading_error_deg"), 0.0, inf),
    "unequipped": (("unequipped",), 0.0, 1.0),
    "burst_loss": (("burst_loss",), 0.0, 0.99),
    "burst_s": (("burst_s",), 0.01, inf),
    "jitter_s": (("jitter_s",), 0.0, inf),
    "message_hz": (("message_hz",), 0.01, inf),
    "range_m": (("range_m",), 0.1, inf),
    "longest_age_s": (("longest_age_s",), 0.01, inf),
}
"""What may be changed of a channel: the fields of `ChannelSpec` that take the value, its least and its largest."""

_CHANGES = re.compile(rf"^(?P<channel>.*?)(?P<changes>(,({'|'.join(CHANGES)})=[^,]*)*)$", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Radio:
    """Radio of a study: a channel, and what is changed of it; None leaves the channel's own value.

    Attributes:
        channel: preset, or `trace:FILE`.
        loss: probability of packet loss, 0 to 1.
        delay_s: latency from measurement to sending, s.
        pose_error: standard deviation of a sender's own position, m, and heading, degrees.
        unequipped, burst_loss, burst_s, jitter_s, message_hz, range_m, longest_age_s: see `ChannelSpec`.
    """

    channel: str = IDEAL
    loss: float | None = None
    delay_s: float | None = None
    pose_error: float | None = None
    unequipped: float | None = None
    burst_loss: float | None = None
    burst_s: float | None = None
    jitter_s: float | None = None
    message_hz: float | None = None
    range_m: float | None = None
    longest_age_s: float | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the radio of a label such as `ideal,loss=0.3`.

        Raises:
            SettingsError: a value is no number, or a change is there twice.
        """
        found = _CHANGES.match(text)
        assert found is not None  # it matches every text
        given = [part.split("=") for part in found["changes"].split(",")[1:]]
        changes = dict(given)
        if len(changes) < len(given):
            raise SettingsError(complaint("channel", "changes", "each once", text))
        try:
            return cls(found["channel"], **{name: float(value) for name, value in changes.items()})
        except ValueError:
            raise SettingsError(complaint("channel", "changes", "numbers", text)) from None

    @property
    def changes(self) -> dict[str, float]:
        """What is changed, by name."""
        return {name: value for name in CHANGES if (value := getattr(self, name)) is not None}

    def changed(
        self, loss: float | None = None, delay_s: float | None = None, pose_error: float | None = None, **more: float
    ) -> Self:
        """Return the radio with other changes; None keeps its own.

        Args:
            more: further fields.
        """
        given: dict[str, Any] = {"loss": loss, "delay_s": delay_s, "pose_error": pose_error, **more}
        return dataclasses.replace(self, **{name: value for name, value in given.items() if value is not None})

    @property
    def label(self) -> str:
        """Name in plans, tables and files, which `parse` reads."""
        return self.channel + "".join(f",{name}={value:g}" for name, value in self.changes.items())

    def spec(self) -> ChannelSpec:
        """Return the settings of the channel, the changes included.

        Raises:
            SettingsError: the preset is unknown, a trace is without its file, or a value out of its range.
            DataError: the trace cannot be read.
        """
        spec = changed_spec(_preset(self.channel), self.changes)
        return spec if self.label == self.channel else replace(spec, name=self.label)


def changed_spec(spec: ChannelSpec, changes: Mapping[str, float]) -> ChannelSpec:
    """Return settings of a channel with changes, by the names of `CHANGES`; SettingsError for one out of its range."""
    for name, value in changes.items():
        fields, least, most = CHANGES[name]
        if not least <= value <= most:
            expected = f"{least:g} to {most:g}"
            raise SettingsError(complaint("channel", name, expected, f"{value:g}"))
        given: dict[str, Any] = dict.fromkeys(fields, value)
        spec = replace(spec, **given)
    return spec


def get_channel(name: str) -> ChannelSpec:
    """Return the settings of a preset, `trace:FILE`, or either with changes, such as `ideal,loss=0.3`; see `Radio`.

    Raises:
        SettingsError: the preset is unknown, a trace is without its file, or a change is wrong.
        DataError: the trace cannot be read.
    """
    return Radio.parse(name).spec()


def _preset(name: str) -> ChannelSpec:
    preset, _, file = name.partition(":")
    if preset not in PRESETS and name.partition(",")[0] in PRESETS:
        keys = [part.partition("=")[0] for part in name.split(",")[1:]]
        wrong = next((key for key in keys if key not in CHANGES), keys[-1])
        raise SettingsError(complaint("channel", "changes", f"NAME=NUMBER of {', '.join(CHANGES)}", wrong))
    if preset not in PRESETS:
        choices = [f"{known}:FILE" if known == "trace" else known for known in PRESETS]
        raise SettingsError(complaint("channel", "name", "a preset", name, did_you_mean(preset, choices)))
    if (preset == "trace") != bool(file):
        expected = "trace:FILE with a CSV file" if preset == "trace" else f"'{preset}' without a file"
        raise SettingsError(complaint("channel", "name", expected, name))
    if not file:
        return PRESETS[preset]
    read_trace(file)
    return replace(PRESETS[preset], trace=file)
