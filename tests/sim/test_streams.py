"""Random streams: numbers that recorded drives are made of, and no number with two purposes."""

import zlib
from collections import Counter

import numpy as np

from sim.streams import Stream, derived_seed, random_generator


def test_both_derivations_give_the_numbers_that_recorded_drives_are_made_of() -> None:
    spawned = np.random.SeedSequence(7, spawn_key=(2, zlib.crc32(b"fog"), 4, 2**32 - 3))
    expected = np.random.default_rng(spawned).random(3)
    np.testing.assert_array_equal(random_generator(7, Stream.CORRUPTION, "fog", 4, -3).random(3), expected)
    listed = np.random.default_rng([7, 1, 5]).random(3)
    np.testing.assert_array_equal(random_generator(7, Stream.TRAINING_ORDER, 5).random(3), listed)
    unnumbered = np.random.default_rng(7).random(3)
    np.testing.assert_array_equal(random_generator(7, Stream.HIGHWAY_TRAFFIC).random(3), unnumbered)
    seeds = np.random.SeedSequence(7, spawn_key=(4, zlib.crc32(b"drive"))).generate_state(1)
    assert derived_seed(7, Stream.CORRUPTION_SEED, "drive") == seeds[0]


def test_no_number_has_two_purposes_under_one_seed() -> None:
    roots = {"RADIO": "channel", "TRAINING": "training"}
    used = Counter(
        (roots.get(stream.name.split("_")[0], "drive"), form, number)
        for stream in Stream
        for form, number, _ in [stream.value]
        if number is not None
    )
    assert max(used.values()) == 1
