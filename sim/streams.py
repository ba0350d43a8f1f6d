"""Random streams: one named stream per purpose, all derived from one root seed.

A stream is a pure function of the seed, its purpose and its keys (frame, agent, name), so that draws for one purpose
never move those for another, and frames can be made in any order and by any process. Recorded drives are made of these
numbers: a new purpose takes a new number, and no number is ever given to another purpose.

Two derivations are in use, both of `numpy.random.SeedSequence`, and never coincide:

* child: ``SeedSequence(seed, spawn_key=(number, *keys))``, for every new stream;
* list: ``SeedSequence([seed, number, *keys])``, the older form. Those without a number are told apart by their keys.

Generators of fixed seeds (tables of the sensor model, samplers of published code, resampling of statistics) are
constants, not streams.
"""

import zlib
from enum import Enum, unique

import numpy as np


@unique
class Stream(Enum):
    """Purposes of random draws: form, number (None: the seed and the keys alone) and keys of each."""

    # Traffic
    DEMAND = "list", 0xDE, "spawned by kind: vehicles, bicycles, persons"
    PARKED_CARS = "list", 0xCA7, ""
    HIGHWAY_TRAFFIC = "list", None, ""
    BODY_MODEL = "list", None, "name of the road user"
    ROAD_USER = "child", 20, "name of the road user, 0 its size or 1 its look"
    # Encounters
    ENCOUNTER_PARAMETER = "list", None, "draw, name of the parameter"
    ENCOUNTER_LAYOUT = "list", None, "draw, 'looks'"
    ENCOUNTER_CHECK = "list", None, "traffic step"
    ENCOUNTER_TRAFFIC = "child", 5, "draw"
    # Static world
    BUILDING_BLOCKS = "list", 1, ""
    FURNITURE = "list", 2, ""
    BUILDING_FOOTPRINTS = "list", 3, ""
    ENCOUNTER_SITE = "list", 4, ""
    FACADES = "list", None, "the seed is the number of buildings"
    RELIEF = "child", 7, "none of the land, 'plots' of what lies beside the streets"
    ROUGHNESS = "child", 8, ""
    BESIDE = "child", 9, "purpose, of what stands beside the roads"
    # Recording
    AGENT_SELECTION = "child", 0, ""
    LIDAR_NOISE = "child", 1, "frame, agent"
    # Corruptions
    CORRUPTION = "child", 2, "kind, 1 + frame (0: a fault that stays for the drive), agent"
    WEATHER = "child", 3, "kind, 0 drift of the strength or 1 patches"
    CORRUPTION_SEED = "child", 4, "name of the drive: a seed for each of many drives"
    SPRAY_NOISE = "list", None, "the seed is drawn from CORRUPTION; frame, agent"
    # Closed loop
    PERCEPTION_ERRORS = "child", 6, "object, or 0 for ghosts"
    FAULT = "child", 23, "kind, 1 + frame or step (0: for the episode), agent"
    # Radio channel, children of the channel's own seed
    RADIO_SHADOWING = "child", 0, "agents, lower id first"
    RADIO_PACKETS = "child", 1, "instant, sender, receiver"
    RADIO_ACCESS = "child", 2, "instant, sender"
    RADIO_PHASE = "child", 3, "sender"
    RADIO_CLOCK = "child", 4, "agent"
    RADIO_COLLISIONS = "child", 5, "instant or reservation, sender"
    RADIO_POSITION = "child", 6, "sender, instant (none where the error is correlated in time)"
    RADIO_LOSSES = "child", 7, "instant, sender, receiver"
    RADIO_BURSTS = "child", 21, "instant, sender, receiver"
    RADIO_JITTER = "child", 22, "instant, sender, receiver"
    RADIO_EQUIPMENT = "child", 24, "agent"
    # Training, lists of the training's own seed
    TRAINING_ORDER = "list", 1, "epoch"
    TRAINING_AUGMENTATION = "list", 2, "epoch, frame"
    TRAINING_CORRUPTION = "list", 3, "epoch, frame"


def random_generator(seed: int, stream: Stream, *keys: int | str) -> np.random.Generator:
    """Return the generator of a stream.

    Args:
        seed: root seed, >= 0.
        keys: see `Stream`; integers are taken modulo 2^32, strings by their CRC-32.
    """
    return np.random.default_rng(_sequence(seed, stream, *keys))


def derived_seed(seed: int, stream: Stream, *keys: int | str) -> int:
    """Return a 32-bit seed of a stream, for a function that takes a seed; arguments as `random_generator`."""
    return int(_sequence(seed, stream, *keys).generate_state(1)[0])


def _sequence(seed: int, stream: Stream, *keys: int | str) -> np.random.SeedSequence:
    form, number, _ = stream.value
    words = [zlib.crc32(key.encode()) if isinstance(key, str) else int(key) % 2**32 for key in keys]
    words = words if number is None else [number, *words]
    if form == "child":
        return np.random.SeedSequence(seed, spawn_key=tuple(words))
    return np.random.SeedSequence([seed, *words])
