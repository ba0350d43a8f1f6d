"""Radio channel over a drive: which message of whom is the newest that has arrived."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from sim.errors import SettingsError, complaint
from sim.radio.budget import (
    dcc_gate_s,
    delivery_probability,
    deviation_db,
    margin_db,
    message_airtime_s,
    packet_count,
)
from sim.radio.spec import HEARING_M, ChannelSpec, Obstruction
from sim.radio.trace import read_trace
from sim.streams import Stream, random_generator

MAX_AGE = 20
"""Largest usable age of a message, instants."""
LEAST_SHARE = 0.5
"""Smallest usable share of received packets; below it an older message is used."""

_WAVES = 64
_RESERVED = 10  # instants that a reservation of the semi-persistent scheduler lasts


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """Reception of one agent's message by another at one instant.

    Attributes:
        sender, receiver: ids of the agents.
        sent: number of the instant of the measurement; -1 without a usable message.
        age_s: time from that instant to now, s; NaN without a message.
        delay_s: latency from measurement to the last packet, s; NaN without a message.
        bytes: size of this message on air.
        packets: number of its packets.
        arrived: (packets,) bool mask of received packets.
        distance_m: distance between the antennas when sent, m.
        sight: obstruction between them then.
        probability: reception probability of a packet, without collisions.
        load: channel busy ratio.
        held: whether the sender sends nothing now: it has nothing to say, or its turn comes later in a full channel.
        offered: size of the message that the sender has now; None for that of this one.
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
    held: bool = False
    offered: int | None = None

    @property
    def bytes_now(self) -> int:
        """Bytes that the sender puts on air now."""
        if self.held:
            return 0
        return self.bytes if self.offered is None else self.offered

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
        bytes: (A,) payload size of each; one with 0 sends nothing.
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
        interval_s: time between instants, s.
        faulted: (number of an instant, sender) -> settings of the messages that it sends then, which differ from `spec`
            in what `CHANGES` names; None: always those of `spec`.

    Raises:
        SettingsError: an interval that is not positive.
        DataError: a trace that cannot be read.
    """

    def __init__(
        self, spec: ChannelSpec, seed: int, interval_s: float, faulted: Callable[[int, int], ChannelSpec] | None = None
    ) -> None:
        if not (math.isfinite(interval_s) and interval_s > 0.0):
            raise SettingsError(complaint("channel", "interval_s", "a positive time", interval_s))
        self.spec, self.seed, self.interval_s = spec, int(seed), float(interval_s)
        self.sent_with = faulted or (lambda index, sender: spec)
        self._trace = read_trace(spec.trace) if spec.medium == "trace" else None
        self._bursts: dict[tuple[int, int, float, float], list[bool]] = {}

    def link(self, instant: RadioSnapshot, sender: int, receiver: int) -> Link:
        """Return the reception of the message that a sender sends at an instant; see `newest` for later use.

        Args:
            instant: instant of sending.
            sender: id of an agent at that instant.
        """
        rows = instant.agent_ids.index(sender), instant.agent_ids.index(receiver)
        place = instant.antenna[list(rows)]
        distance = float(np.linalg.norm(place[0] - place[1]))
        sight = Obstruction(int(instant.sight[rows]))
        size = self._on_air(instant.bytes[rows[0]])
        packets = packet_count(self.spec, size)
        load, stride, others_s = self._load(instant, rows[0])
        spec = self.sent_with(instant.index, sender)
        probability, delay, loss = 1.0, spec.delay_s, 0.0
        arrived = np.ones(packets, bool)
        if self.spec.medium in ("csma", "sps"):
            probability = delivery_probability(spec, distance, sight)
            arrived = self._received(sender, receiver, instant.index, place, distance, sight, packets)
            arrived &= ~self._collided(sender, instant.index, packets, load)
            delay += self._access_s(sender, instant.index, others_s) + message_airtime_s(self.spec, size)
        elif self._trace is not None:
            delay, loss = self._trace.at(instant.index * self.interval_s, sender, receiver)
            probability = 1.0 - loss
            arrived = self._rng(Stream.RADIO_PACKETS, instant.index, sender, receiver).random(packets) >= loss
        if spec.packet_loss:
            probability *= 1.0 - spec.packet_loss
            rng = self._rng(Stream.RADIO_LOSSES, instant.index, sender, receiver)
            arrived &= rng.random(packets) >= spec.packet_loss
        if spec.burst_loss:
            probability *= 1.0 - spec.burst_loss
            arrived &= not self._down(spec, sender, receiver, instant.index)
        if spec.jitter_s:
            delay += spec.jitter_s * float(
                self._rng(Stream.RADIO_JITTER, instant.index, sender, receiver).standard_exponential()
            )
        if spec.message_hz is not None:
            stride = max(stride, math.ceil(1.0 / (spec.message_hz * self.interval_s) - 1e-9))
        held = not self._says(instant, rows[0]) or instant.index % stride != self._phase(sender, stride)
        if held or distance > spec.range_m:
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
            held=held,
        )

    def newest(self, instants: Sequence[RadioSnapshot], sender: int, receiver: int) -> Link:
        """Return the newest message of a sender received by now.

        Args:
            instants: now, then earlier ones, newest first; those beyond `MAX_AGE` are ignored.
            sender: id of an agent now.
        """
        now = instants[0].index
        longest_s = self.sent_with(now, sender).longest_age_s
        first = None
        for instant in islice(instants, MAX_AGE + 1):  # not a slice: instants may be made lazily
            if sender not in instant.agent_ids or receiver not in instant.agent_ids:
                continue
            link = self.link(instant, sender, receiver)
            first = first or link
            age_s = (now - instant.index) * self.interval_s
            if longest_s is not None and age_s > longest_s + 1e-9:
                break
            if link.received and link.delay_s <= age_s + 1e-9:
                return dataclasses.replace(link, age_s=age_s, held=first.held, offered=first.bytes)
        if first is None:
            raise KeyError(sender)
        return dataclasses.replace(first, sent=-1, age_s=math.nan, delay_s=math.nan)

    def clock_error_s(self, agent_id: int) -> float:
        """Return the clock offset of an agent, constant over the drive, s; positive is ahead."""
        return self.spec.clock_error_s * float(self._rng(Stream.RADIO_CLOCK, agent_id).standard_normal())

    def _on_air(self, size: int) -> int:
        return self.spec.message_bytes if size and self.spec.message_bytes is not None else int(size)

    def _load(self, instant: RadioSnapshot, row: int) -> tuple[float, int, float]:
        """Return channel load around an agent, stride of its instants, and airtime of the others, s."""
        if self.spec.medium not in ("csma", "sps"):
            return 0.0, 1, 0.0
        near = np.linalg.norm(instant.antenna - instant.antenna[row], axis=1) <= HEARING_M
        sizes = [self._on_air(self._says(instant, one)) for one in range(len(instant.bytes))]
        air = np.array([message_airtime_s(self.spec, size) if size else 0.0 for size in sizes])
        total = float(air[near].sum())
        pause = dcc_gate_s(total / self.interval_s) if self.spec.congestion_control else 0.0
        stride = max(1, math.ceil(max(pause, total) / self.interval_s - 1e-9))
        return min(1.0, total / (stride * self.interval_s)), stride, total - float(air[row])

    def _says(self, instant: RadioSnapshot, row: int) -> int:
        """Return the bytes that an agent sends, none without a radio; a larger share takes more of the same agents."""
        agent = instant.agent_ids[row]
        share = self.sent_with(instant.index, agent).unequipped
        without = share > 0.0 and self._rng(Stream.RADIO_EQUIPMENT, agent).random() < share
        return 0 if without else instant.bytes[row]

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

    def _down(self, spec: ChannelSpec, sender: int, receiver: int, index: int) -> bool:
        """Return whether a link is down in an instant: a chain from the drive's first instant on, whenever asked."""
        ends = min(1.0, self.interval_s / spec.burst_s)
        begins = min(1.0, ends * spec.burst_loss / (1.0 - spec.burst_loss))
        known = self._bursts.setdefault((sender, receiver, ends, begins), [])
        while len(known) <= index:
            draw = float(self._rng(Stream.RADIO_BURSTS, len(known), sender, receiver).random())
            known.append(draw < (spec.burst_loss if not known else 1.0 - ends if known[-1] else begins))
        return known[index]

    def _rng(self, stream: Stream, *keys: int) -> np.random.Generator:
        return random_generator(self.seed, stream, *keys)
