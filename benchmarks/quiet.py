"""Timing on a machine that others use too: variants take turns, and the least disturbed samples of each count."""

import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_STAT = Path("/proc/stat")
_SLOW_S = 0.2
"""A call that takes so long keeps nothing warm that matters."""


@dataclass(frozen=True, slots=True)
class Timing:
    """How long one call takes.

    Attributes:
        wall_s: median over the quietest samples, s.
        cpu_s: the same of the CPU time of all threads: the better figure of one thread where nothing is ever quiet.
        load: median over the same of how many cores other processes kept busy; NaN where the system does not say.
        samples: how many they are.
        calls: calls per sample.
    """

    wall_s: float
    cpu_s: float
    load: float
    samples: int
    calls: int


def measure(
    variants: Mapping[str, Callable[[], object]], *, rounds: int, keep: int, sample_s: float, most_s: float = math.inf
) -> dict[str, Timing]:
    """Time variants against one another.

    Each round takes one sample of every variant, in turning order, so that a slower minute hits all alike.

    Args:
        variants: what to call, by name; called beforehand, so that nothing is compiled or built in a sample.
        rounds: samples of each.
        keep: how many of them count: those during which other processes worked least.
        sample_s: least duration of a sample, s; filled up with calls.
        most_s: time for all samples of a variant, s; one whose calls take longer sits out some rounds, and has two
            samples at least.
    """
    duration = {name: _warm_seconds(run) for name, run in variants.items()}
    calls = {name: max(1, int(np.ceil(sample_s / duration[name]))) for name in variants}
    samples: dict[str, list[tuple[float, float, float]]] = {name: [] for name in variants}
    turns = {name: int(np.clip(most_s / duration[name], 2, rounds)) for name in variants}
    names = list(variants)
    for turn in range(rounds):
        for name in names[turn % len(names) :] + names[: turn % len(names)]:
            if (turn + 1) * turns[name] // rounds == turn * turns[name] // rounds:
                continue
            if duration[name] < _SLOW_S:
                # What other variants pushed out of caches, the engine's and the processor's, comes back off the clock.
                variants[name]()
            samples[name].append(_sample(variants[name], calls[name]))
    return {name: _timing(np.array(taken), keep, calls[name]) for name, taken in samples.items()}


def _timing(samples: NDArray[np.float64], keep: int, calls: int) -> Timing:
    """Take the quietest of (N, 3) rows load, wall and CPU time; by the load alone, not by how fast they were."""
    quietest = samples[np.argsort(samples[:, 0], kind="stable")[:keep]]
    load, wall, cpu = np.median(quietest, axis=0).tolist()
    return Timing(wall, cpu, load, len(quietest), calls)


def _warm_seconds(run: Callable[[], object]) -> float:
    """Return the duration of a second call: the first one may compile and build."""
    run()
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def _sample(run: Callable[[], object], calls: int) -> tuple[float, float, float]:
    """Return how many cores others kept busy meanwhile, and seconds and CPU seconds per call."""
    others, own, start = others_s(), time.process_time(), time.perf_counter()
    for _ in range(calls):
        run()
    wall = time.perf_counter() - start
    return (others_s() - others) / wall, wall / calls, (time.process_time() - own) / calls


def others_s() -> float:
    """Return the CPU time that all other processes have used since the start of the machine, s."""
    if not _STAT.exists():
        return float("nan")
    user, nice, system, _, _, irq, softirq, steal = map(int, _STAT.read_text().split("\n", 1)[0].split()[1:9])
    busy = (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")
    return busy - time.process_time()
