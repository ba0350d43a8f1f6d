"""Link budget and airtime of packets at 5.9 GHz; sizes of messages and what a lost packet takes with it."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.radio.spec import ChannelSpec, Obstruction

FREQUENCY_GHZ = 5.9
CPM_BYTES, CPM_BYTES_PER_OBJECT = 156, 35
"""Collective Perception Message (ETSI TS 103 324), bytes: header, station and one sensor; each object."""


def path_loss_db(distance_m: ArrayLike, sight: Obstruction, environment: str = "urban") -> NDArray[np.float64]:
    """Return the mean path loss at 5.9 GHz, dB. Source: 3GPP TR 37.885, 6.2.1; antennas on roofs of cars.

    Args:
        distance_m: between the antennas, m; at least 1 m.
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
