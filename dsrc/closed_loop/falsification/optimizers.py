"""Optimisers of a search: the next points to try, from the values of those that were tried.

Points are asked for and told in rounds of a fixed length, so that the search is the same for any number of workers.
"""

import warnings
from collections.abc import Iterator, Sequence
from itertools import chain, product, zip_longest
from typing import Any, Protocol

import numpy as np

from dsrc.closed_loop.falsification.space import Point, Space
from dsrc.options.search import OptimizerName
from sim.errors import SettingsError

ROUND = 4
"""Points of a round."""
_STARTS = 12
"""Random points with which the tree-structured Parzen estimator begins."""


class Optimizer(Protocol):
    """What tells which points to try."""

    def ask(self, count: int) -> list[Point]:
        """Return the next points."""
        ...

    def tell(self, values: Sequence[float]) -> None:
        """Take the values of the points that were asked for last; less is better."""
        ...


def open_optimizer(name: OptimizerName, space: Space, budget: int, seed: int) -> Optimizer:
    """Return an optimiser.

    Args:
        name: `random`: uniform; `grid`: a grid of all dimensions for each choice, as fine as the budget allows;
            `tpe`: tree-structured Parzen estimator (Bergstra, Bardenet, Bengio and Kegl, NeurIPS 2011) of the package
            optuna (Akiba et al., KDD 2019).
        budget: number of points.
        seed: of its draws.

    Raises:
        SettingsError: the package is missing.
    """
    if name == "tpe":
        return _Parzen(space, seed)
    points = _random(space, seed) if name == "random" else _grid(space, budget)
    return _Listed(points)


class _Listed:
    """Points that do not depend on values."""

    def __init__(self, points: Iterator[Point]) -> None:
        self._points = points

    def ask(self, count: int) -> list[Point]:
        return [next(self._points) for _ in range(count)]

    def tell(self, values: Sequence[float]) -> None:
        pass


def _random(space: Space, seed: int) -> Iterator[Point]:
    rng = np.random.default_rng(seed)
    while True:
        choice = space.choices[int(rng.integers(len(space.choices)))]
        yield Point(choice, tuple(rng.random(len(space.dimensions(choice))).tolist()))


def _grid(space: Space, budget: int) -> Iterator[Point]:
    """Yield the points of a grid of each choice in turn, and then those of finer grids."""
    fine = 0
    while True:
        share = -(-budget // len(space.choices)) + fine
        grids = [_grid_of(space, choice, share) for choice in space.choices]
        yield from (point for point in chain.from_iterable(zip_longest(*grids)) if point is not None)
        fine += max(1, budget)


def _grid_of(space: Space, choice: tuple[int, int, int], count: int) -> list[Point]:
    """Return a grid of at least so many points, evenly thinned to as many: one corner first, the other last."""
    dimensions = space.dimensions(choice)
    levels = [1] * len(dimensions)
    row = 0
    while dimensions and int(np.prod(levels)) < count:
        levels[row % len(levels)] += 1
        row += 1
    axes = [np.linspace(0.0, 1.0, level).tolist() if level > 1 else [0.5] for level in levels]
    whole = list(product(*axes))
    rows = np.unique(np.linspace(0, len(whole) - 1, min(count, len(whole))).round().astype(int))
    return [Point(choice, tuple(whole[k])) for k in rows.tolist()]


class _Parzen:
    """Tree-structured Parzen estimator of optuna."""

    def __init__(self, space: Space, seed: int) -> None:
        try:
            import optuna
        except ImportError:
            hint = "pip install 'dsrc-testbed[search]', or --optimizer random"
            raise SettingsError(f"search: optimizer tpe needs the package optuna: {hint}") from None
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            sampler = optuna.samplers.TPESampler(
                seed=seed, multivariate=True, group=True, constant_liar=True, n_startup_trials=_STARTS
            )
        self._space = space
        self._study = optuna.create_study(sampler=sampler)
        self._asked: list[Any] = []

    def ask(self, count: int) -> list[Point]:
        self._asked = [self._study.ask() for _ in range(count)]
        return [self._point(trial) for trial in self._asked]

    def tell(self, values: Sequence[float]) -> None:
        for trial, value in zip(self._asked, values, strict=True):
            self._study.tell(trial, value)

    def _point(self, trial: Any) -> Point:
        space = self._space
        counts = {"scenario": len(space.scenarios), "seed": len(space.seeds), "fault": len(space.templates)}
        rows = [trial.suggest_categorical(name, list(range(n))) if n > 1 else 0 for name, n in counts.items()]
        choice = rows[0], rows[1], rows[2]
        own = len(space.templates[choice[2]].dimensions)
        names = [f"{choice[2]}.{k}" if k < own else f"parameter.{k - own}" for k in range(own + len(space.parameters))]
        return Point(choice, tuple(trial.suggest_float(name, 0.0, 1.0) for name in names))
