"""Settings of radio channels: presets by name."""

import dataclasses
import re
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

    def decisive(self) -> dict[str, Any]:
        """Return what decides the deliveries, of plain values: parts of keys; of a trace the hash of its file."""
        settings = msgspec.to_builtins(self)
        del settings["name"]
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


_CHANGES = re.compile(r"^(?P<channel>.*?)(?P<changes>(,(loss|delay_s|pose_error)=[^,]*)*)$", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Radio:
    """Radio of a study: a channel, and what is changed of it; None leaves the channel's own value.

    Attributes:
        channel: preset, or `trace:FILE`.
        loss: probability of packet loss, 0 to 1.
        delay_s: latency from measurement to sending, s.
        pose_error: standard deviation of a sender's own position, m, and heading, degrees.
    """

    channel: str = IDEAL
    loss: float | None = None
    delay_s: float | None = None
    pose_error: float | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the radio of a label such as `ideal,loss=0.3`.

        Raises:
            SettingsError: a value is no number.
        """
        found = _CHANGES.match(text)
        assert found is not None  # it matches every text
        changes = dict(part.split("=") for part in found["changes"].split(",")[1:])
        try:
            return cls(found["channel"], **{name: float(value) for name, value in changes.items()})
        except ValueError:
            raise SettingsError(complaint("channel", "changes", "numbers", text)) from None

    def changed(self, loss: float | None = None, delay_s: float | None = None, pose_error: float | None = None) -> Self:
        """Return the radio with other changes; None keeps its own."""
        return dataclasses.replace(
            self,
            loss=self.loss if loss is None else loss,
            delay_s=self.delay_s if delay_s is None else delay_s,
            pose_error=self.pose_error if pose_error is None else pose_error,
        )

    @property
    def label(self) -> str:
        """Name in plans, tables and files, which `parse` reads."""
        values = (("loss", self.loss), ("delay_s", self.delay_s), ("pose_error", self.pose_error))
        return self.channel + "".join(f",{name}={value:g}" for name, value in values if value is not None)

    def spec(self) -> ChannelSpec:
        """Return the settings of the channel, the changes included.

        Raises:
            SettingsError: the preset is unknown, a trace is without its file, or a value out of its range.
            DataError: the trace cannot be read.
        """
        spec = _preset(self.channel)
        for field in ("loss", "delay_s", "pose_error"):
            value, most = getattr(self, field), 1.0 if field == "loss" else inf
            if value is not None and not 0.0 <= value <= most:
                raise SettingsError(complaint("channel", field, f"0 to {most:g}", f"{value:g}"))
        if self.pose_error is not None:
            spec = replace(spec, position_error_m=self.pose_error, heading_error_deg=self.pose_error)
        if self.delay_s is not None:
            spec = replace(spec, delay_s=self.delay_s)
        if self.loss is not None:
            spec = replace(spec, packet_loss=self.loss)
        return spec if self.label == self.channel else replace(spec, name=self.label)


def get_channel(name: str) -> ChannelSpec:
    """Return the settings of a preset, `trace:FILE`, or either with changes, such as `ideal,loss=0.3`; see `Radio`.

    Raises:
        SettingsError: the preset is unknown, a trace is without its file, or a change is wrong.
        DataError: the trace cannot be read.
    """
    return Radio.parse(name).spec()


def _preset(name: str) -> ChannelSpec:
    preset, _, file = name.partition(":")
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
