"""Radio channel: delivery, latency and bytes of messages between agents.

An abstract model at 5.9 GHz, one link budget per message and one draw per packet:

1. A message is cut into packets of `packet_bytes`; each takes the air for 40 us of preamble and as many symbols of
   8 us as its bits and 22 bits of service and tail need at the data rate (IEEE 802.11p), or for whole ms (LTE).
2. The airtimes of all agents in carrier sense range add up to the channel load. A message waits for a random share of
   the others' packets; with reactive congestion control (ETSI TS 102 687) a sender skips instants when the load is
   high, and also when the packets of one instant do not fit before the next.
3. The mean received power follows 3GPP TR 37.885 for a free line of sight, one through vehicles, and one through
   buildings. Around it the power varies as there (3 or 4 dB; 4.5 dB more through vehicles). Half of that variance is
   shadowing, which changes over 10 m (urban) or 25 m (motorway) of travel, half is drawn for every packet.
   A packet is received when the power is above the noise by `snr_db`: on average with the probability
   Phi((P - PL - threshold) / sigma). The split into halves is assumed; the average does not depend on it.
4. Packets are also lost by collisions, in proportion to the load.

Every draw is a function of the seed, the link and the number of the instant, whatever the order of calls.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import islice
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from msgspec.structs import replace
from numpy.typing import ArrayLike, NDArray

from sim.errors import SettingsError, complaint, did_you_mean
from sim.radio_trace import read_trace
from sim.scenario import NonNegative, Positive
from sim.streams import Stream, random_generator

IDEAL = "ideal"
FREQUENCY_GHZ = 5.9
HEARING_M = 500.0
"""Carrier sense range: agents within it count for the channel load, m."""
MAX_AGE = 20
"""Largest usable age of a message, instants."""
LEAST_SHARE = 0.5
"""Smallest usable share of received packets; below it an older message is used."""

CPM_BYTES, CPM_BYTES_PER_OBJECT = 156, 35
"""Collective Perception Message (ETSI TS 103 324), bytes: header, station and one sensor; each object."""

_WAVES = 64
_RESERVED = 10  # instants that a reservation of the semi-persistent scheduler lasts


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


def get_channel(name: str) -> ChannelSpec:
    """Return the settings of a preset; `trace:FILE` names the file of a trace.

    Raises:
        SettingsError: the preset is unknown, or a trace without its file.
        DataError: the trace cannot be read.
    """
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


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """Reception of one agent's message by another at one instant.

    Attributes:
        sender, receiver: ids of the agents.
        sent: number of the instant of the measurement; -1 without a usable message.
        age_s: time from that instant to now, s; NaN without a message.
        delay_s: latency from measurement to the last packet, s; NaN without a message.
        bytes: bytes on air for this message.
        packets: number of its packets.
        arrived: (packets,) bool mask of received packets.
        distance_m: distance between the antennas when sent, m.
        sight: obstruction between them then.
        probability: reception probability of a packet, without collisions.
        load: channel busy ratio.
    """

    sender: int
    receiver: int
    sent: int
    age_s: float
    delay_s: float
    bytes: int
    packets: int
    arrived: NDArray[np.bool_]
    distance_m: float
    sight: Obstruction
    probability: float
    load: float

    @property
    def received(self) -> bool:
        """Whether there is a usable message."""
        return self.sent >= 0


@dataclass(frozen=True, slots=True, eq=False)
class RadioSnapshot:
    """Inputs of the channel at one instant, A agents.

    Attributes:
        index: number of the instant.
        agent_ids: (A,) ids.
        antenna: (A, 3) positions of the antennas in the world, m.
        bytes: (A,) payload size of each.
        sight: (A, A) `Obstruction` between them.
    """

    index: int
    agent_ids: tuple[int, ...]
    antenna: NDArray[np.float64]
    bytes: tuple[int, ...]
    sight: NDArray[np.int8]


class Channel:
    """Radio channel over a drive.

    Args:
        spec: settings.
        seed: root seed.
        interval_s: time between instants, s.

    Raises:
        SettingsError: an interval that is not positive.
        DataError: a trace that cannot be read.
    """

    def __init__(self, spec: ChannelSpec, seed: int, interval_s: float) -> None:
        if not (math.isfinite(interval_s) and interval_s > 0.0):
            raise SettingsError(complaint("channel", "interval_s", "a positive time", interval_s))
        self.spec, self.seed, self.interval_s = spec, int(seed), float(interval_s)
        self._trace = read_trace(spec.trace) if spec.medium == "trace" else None

    def link(self, instant: RadioSnapshot, sender: int, receiver: int) -> Link:
        """Return the reception of the message that a sender sends at an instant; see `newest` for later use.

        Args:
            instant: instant of sending.
            sender: id of an agent at that instant.
            receiver: id of another.
        """
        rows = instant.agent_ids.index(sender), instant.agent_ids.index(receiver)
        place = instant.antenna[list(rows)]
        distance = float(np.linalg.norm(place[0] - place[1]))
        sight = Obstruction(int(instant.sight[rows]))
        size = self._on_air(instant.bytes[rows[0]])
        packets = packet_count(self.spec, size)
        load, stride, others_s = self._load(instant, rows[0])
        probability, delay, loss = 1.0, self.spec.delay_s, 0.0
        arrived = np.ones(packets, bool)
        if self.spec.medium in ("csma", "sps"):
            probability = delivery_probability(self.spec, distance, sight)
            arrived = self._received(sender, receiver, instant.index, place, distance, sight, packets)
            arrived &= ~self._collided(sender, instant.index, packets, load)
            delay += self._access_s(sender, instant.index, others_s) + message_airtime_s(self.spec, size)
        elif self._trace is not None:
            delay, loss = self._trace.at(instant.index * self.interval_s, sender, receiver)
            probability = 1.0 - loss
            arrived = self._rng(Stream.RADIO_PACKETS, instant.index, sender, receiver).random(packets) >= loss
        if self.spec.packet_loss:
            probability *= 1.0 - self.spec.packet_loss
            rng = self._rng(Stream.RADIO_LOSSES, instant.index, sender, receiver)
            arrived &= rng.random(packets) >= self.spec.packet_loss
        if distance > self.spec.range_m or instant.index % stride != self._phase(sender, stride):
            arrived = np.zeros(packets, bool)
        received = float(arrived.mean()) >= LEAST_SHARE
        return Link(
            sender=sender,
            receiver=receiver,
            sent=instant.index if received else -1,
            age_s=0.0 if received else math.nan,
            delay_s=delay if received else math.nan,
            bytes=size,
            packets=packets,
            arrived=arrived,
            distance_m=distance,
            sight=sight,
            probability=probability,
            load=load,
        )

    def newest(self, instants: Sequence[RadioSnapshot], sender: int, receiver: int) -> Link:
        """Return the newest message of a sender received by now.

        Args:
            instants: now, then earlier ones, newest first; those beyond `MAX_AGE` are ignored.
            sender: id of an agent now.
            receiver: id of another.
        """
        now = instants[0].index
        first = None
        for instant in islice(instants, MAX_AGE + 1):  # not a slice: instants may be made lazily
            if sender not in instant.agent_ids or receiver not in instant.agent_ids:
                continue
            link = self.link(instant, sender, receiver)
            first = first or link
            age_s = (now - instant.index) * self.interval_s
            if link.received and link.delay_s <= age_s + 1e-9:
                return dataclasses.replace(link, age_s=age_s)
        if first is None:
            raise KeyError(sender)
        return dataclasses.replace(first, sent=-1, age_s=math.nan, delay_s=math.nan)

    def clock_error_s(self, agent_id: int) -> float:
        """Return the clock offset of an agent, constant over the drive, s; positive is ahead."""
        return self.spec.clock_error_s * float(self._rng(Stream.RADIO_CLOCK, agent_id).standard_normal())

    def _on_air(self, size: int) -> int:
        return self.spec.message_bytes if self.spec.message_bytes is not None else int(size)

    def _load(self, instant: RadioSnapshot, row: int) -> tuple[float, int, float]:
        """Return channel load around an agent, stride of its instants, and airtime of the others, s."""
        if self.spec.medium not in ("csma", "sps"):
            return 0.0, 1, 0.0
        near = np.linalg.norm(instant.antenna - instant.antenna[row], axis=1) <= HEARING_M
        sizes = [self._on_air(size) for size in instant.bytes]
        air = np.array([message_airtime_s(self.spec, size) for size in sizes])
        total = float(air[near].sum())
        pause = dcc_gate_s(total / self.interval_s) if self.spec.congestion_control else 0.0
        stride = max(1, math.ceil(max(pause, total) / self.interval_s - 1e-9))
        return min(1.0, total / (stride * self.interval_s)), stride, total - float(air[row])

    def _phase(self, sender: int, stride: int) -> int:
        return int(self._rng(Stream.RADIO_PHASE, sender).integers(2**31)) % stride

    def _access_s(self, sender: int, index: int, others_s: float) -> float:
        wait = float(self._rng(Stream.RADIO_ACCESS, index, sender).random())
        return wait * (self.spec.period_s if self.spec.medium == "sps" else others_s)

    def _received(
        self,
        sender: int,
        receiver: int,
        index: int,
        place: NDArray[np.float64],
        distance: float,
        sight: Obstruction,
        packets: int,
    ) -> NDArray[np.bool_]:
        margin, spread = margin_db(self.spec, distance, sight), deviation_db(sight)
        slow = self._shadow(sender, receiver, place)
        fast = self._rng(Stream.RADIO_PACKETS, index, sender, receiver).standard_normal(packets)
        return margin + spread * math.sqrt(0.5) * (slow + fast) > 0.0

    def _shadow(self, sender: int, receiver: int, place: NDArray[np.float64]) -> float:
        """Return the shadowing, standard normal and correlated over the travel of both ends, equal in both directions.

        A sum of cosines whose frequencies have the spectral density of exp(-way / reach) (Rahimi, Recht 2007).
        """
        low, high = sorted((sender, receiver))
        rng = self._rng(Stream.RADIO_SHADOWING, low, high)
        reach_m = 10.0 if self.spec.environment == "urban" else 25.0
        # The density of an exponential in four dimensions is a Cauchy distribution of as many.
        frequency = rng.standard_normal((_WAVES, 4)) / np.abs(rng.standard_normal((_WAVES, 1))) / reach_m
        phase = rng.uniform(0.0, 2.0 * math.pi, _WAVES)
        ends = place[:, :2] if sender <= receiver else place[::-1, :2]
        return math.sqrt(2.0 / _WAVES) * float(np.cos(frequency @ ends.ravel() + phase).sum())

    def _collided(self, sender: int, index: int, packets: int, load: float) -> NDArray[np.bool_]:
        """Return the (packets,) mask of collisions; under semi-persistent scheduling it is equal over a reservation."""
        share = self.spec.collision_share * load
        if self.spec.medium == "sps":
            reservation = index // _RESERVED
            return np.full(packets, self._rng(Stream.RADIO_COLLISIONS, reservation, sender).random() < share)
        return self._rng(Stream.RADIO_COLLISIONS, index, sender).random(packets) < share

    def _rng(self, stream: Stream, *keys: int) -> np.random.Generator:
        return random_generator(self.seed, stream, *keys)


def path_loss_db(distance_m: ArrayLike, sight: Obstruction, environment: str = "urban") -> NDArray[np.float64]:
    """Return the mean path loss at 5.9 GHz, dB. Source: 3GPP TR 37.885, 6.2.1; antennas on roofs of cars.

    Args:
        distance_m: between the antennas, m; at least 1 m.
        sight: obstruction between them.
        environment: `urban` or `highway`, for a free line of sight.
    """
    log_d = np.log10(np.maximum(np.asarray(distance_m, np.float64), 1.0))
    log_f = math.log10(FREQUENCY_GHZ)
    if sight == Obstruction.BUILDING:
        return 36.85 + 30.0 * log_d + 18.9 * log_f
    free = 38.77 + 16.7 * log_d + 18.2 * log_f if environment == "urban" else 32.4 + 20.0 * log_d + 20.0 * log_f
    return free + (9.0 + np.maximum(0.0, 15.0 * log_d - 41.0) if sight == Obstruction.VEHICLE else 0.0)


def deviation_db(sight: Obstruction) -> float:
    """Return the standard deviation of the received power, dB. Source: 3GPP TR 37.885."""
    return {Obstruction.FREE: 3.0, Obstruction.VEHICLE: math.hypot(3.0, 4.5), Obstruction.BUILDING: 4.0}[sight]


def margin_db(spec: ChannelSpec, distance_m: float, sight: Obstruction) -> float:
    """Return the link margin: mean received power above the required one, dB."""
    loss = float(path_loss_db(distance_m, sight, spec.environment))
    return spec.power_dbm - loss - (spec.noise_dbm + spec.snr_db)


def delivery_probability(spec: ChannelSpec, distance_m: float, sight: Obstruction) -> float:
    """Return the delivery probability of a packet, without collisions."""
    return 0.5 * math.erfc(-margin_db(spec, distance_m, sight) / (deviation_db(sight) * math.sqrt(2.0)))


def airtime_s(spec: ChannelSpec, size: int) -> float:
    """Return the airtime of a packet of `size` bytes, s.

    802.11p: 40 us and ceil((22 + 8 B) / (8 R)) symbols of 8 us; LTE: whole subframes of 1 ms.
    """
    if spec.medium == "sps":
        return 1e-3 * math.ceil(8e-3 * size / spec.rate_mbps)
    return 1e-6 * (40.0 + 8.0 * math.ceil((22 + 8 * size) / (8.0 * spec.rate_mbps) - 1e-9))


def packet_count(spec: ChannelSpec, size: int) -> int:
    """Return the number of packets of a message of `size` bytes, at least one."""
    return max(1, math.ceil(size / spec.packet_bytes))


def message_airtime_s(spec: ChannelSpec, size: int) -> float:
    """Return the airtime of a message of `size` bytes, s."""
    full, rest = divmod(size, spec.packet_bytes)
    tail = airtime_s(spec, rest) if rest or not full else 0.0
    return full * airtime_s(spec, spec.packet_bytes) + tail


def dcc_gate_s(load: float) -> float:
    """Return the shortest time between two messages at a channel load, s. Source: ETSI TS 102 687 (reactive)."""
    for limit, gate_s in ((0.19, 0.06), (0.27, 0.1), (0.35, 0.18), (0.43, 0.26), (0.51, 0.34), (0.59, 0.42)):
        if load < limit:
            return gate_s
    return 0.46


def cpm_bytes(objects: int) -> int:
    """Return the size of a Collective Perception Message of n objects, bytes."""
    return CPM_BYTES + CPM_BYTES_PER_OBJECT * int(objects)


def lost_tiles(arrived: NDArray[np.bool_], rows: int, columns: int) -> NDArray[np.bool_]:
    """Return the (rows, columns) mask of tiles of a feature map that lost packets cover.

    The map is sent row by row, in equal shares per packet.
    """
    count, tiles = len(arrived), rows * columns
    edges = np.arange(tiles + 1) * count / tiles
    first = np.floor(edges[:-1] + 1e-9).astype(int)
    last = np.maximum(np.ceil(edges[1:] - 1e-9).astype(int), first + 1)
    missing = np.concatenate([[0], np.cumsum(~arrived)])
    return (missing[last] > missing[first]).reshape(rows, columns)
