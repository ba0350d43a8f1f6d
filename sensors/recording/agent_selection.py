"""Agent selection: the vehicles of a drive that carry a LiDAR, chosen once."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim.errors import ScenarioError, complaint, did_you_mean
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.traffic.staying import carrier_ids, staying_ids

_NEARLY_BEST = 0.9


def choose_agents(drive: Sequence[Actors], scenario: Scenario, rng: np.random.Generator) -> list[int]:
    """Choose the connected vehicles of a drive, ego first.

    Candidates are cars and vans on the road and inside the scenario's area at every instant, so that every agent has
    every timestamp. The score of an ego is the share of the time that its best partners spend within `within_m` of it;
    the ego is drawn among the best scores, weighted by its travelled distance. Its partners are drawn among the
    vehicles that are near it about equally long.

    Args:
        drive: the actors at each frame, at least one.
        scenario: gives the rule, the area and the name for messages.

    Raises:
        ScenarioError: too few vehicles stay for the whole drive, or a named one leaves.
    """
    rule = scenario.agents
    if rule.named:
        return _named(drive, scenario)
    if rule.vehicles == 0:
        return []
    ids = staying_ids(drive, scenario)
    if len(ids) < rule.vehicles:
        raise ScenarioError(_too_few(drive, scenario, len(ids)))
    xy = np.stack([actors.boxes.center[np.searchsorted(actors.boxes.object_id, ids), :2] for actors in drive])
    partners, score = _partners(xy, rule.vehicles - 1, rule.within_m, rng)
    good = np.flatnonzero(score >= _NEARLY_BEST * score.max())
    travelled = np.linalg.norm(np.diff(xy, axis=0), axis=-1).sum(axis=0)[good]
    weight = 1.0 + travelled
    ego = int(good[rng.choice(len(good), p=weight / weight.sum())])
    return [int(ids[row]) for row in (ego, *partners[ego])]


def nearest_agents(actors: Actors, scenario: Scenario, ego_id: int) -> list[int]:
    """Choose the connected vehicles of a drive whose future is unknown, ego first.

    Those that the rule names, else the nearest cars and vans that are not parked, inside the area and within
    `within_m` of the ego, nearest first, up to the number of the rule.

    Args:
        actors: at the start of the drive.
        scenario: gives the rule and the area.
    """
    rule = scenario.agents
    ids = actors.boxes.object_id
    if rule.named:
        helpers = [int(ids[actors.name.index(name)]) for name in rule.named if name in actors.name]
    else:
        distance = np.linalg.norm(actors.boxes.center[:, :2] - actors.boxes.center[actors.row(ego_id), :2], axis=1)
        fit = np.isin(ids, carrier_ids(actors, scenario)) & (distance <= rule.within_m) & (ids != ego_id)
        nearest = np.flatnonzero(fit)[np.argsort(distance[fit], kind="stable")]
        helpers = ids[nearest[: max(rule.vehicles - 1, 0)]].tolist()
    return [ego_id, *(helper for helper in helpers if helper != ego_id)]


def _named(drive: Sequence[Actors], scenario: Scenario) -> list[int]:
    chosen = []
    for name in scenario.agents.named:
        if name not in drive[0].name:
            hint = did_you_mean(name, drive[0].name)
            raise ScenarioError(complaint(scenario.name, "agents.named", "names of road users", f"'{name}'", hint))
        chosen.append(int(drive[0].boxes.object_id[drive[0].name.index(name)]))
        left = [frame for frame, actors in enumerate(drive) if chosen[-1] not in actors.boxes.object_id]
        if left:
            expected = f"vehicles that stay for all {len(drive)} frames"
            found = f"'{name}', which leaves before frame {left[0]}"
            raise ScenarioError(complaint(scenario.name, "agents.named", expected, found))
    return chosen


def _partners(
    xy: NDArray[np.float64], count: int, within_m: float, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return `count` partners of each vehicle (V, count) and the share of the time near its best ones (V,).

    Args:
        xy: (T, V, 2) m.
        within_m: distance that counts as near.
        rng: draws among partners whose shares agree to a tenth, not always the nearest, which see what the ego sees.
    """
    vehicles = xy.shape[1]
    together = np.zeros((vehicles, vehicles))
    for instant in xy:
        together += np.linalg.norm(instant[:, None] - instant[None], axis=-1) <= within_m
    together /= len(xy)
    np.fill_diagonal(together, -1.0)
    rank = np.floor(10.0 * together + 1e-9) + rng.random((vehicles, vehicles))
    partners = np.argsort(-rank, axis=1, kind="stable")[:, :count]
    best = -np.sort(-together, axis=1)[:, :count]
    return partners, best.sum(axis=1) if count else np.ones(vehicles)


def _too_few(drive: Sequence[Actors], scenario: Scenario, found: int) -> str:
    wanted = scenario.agents.vehicles
    low, high = 0, len(drive)
    while low + 1 < high:
        middle = (low + high) // 2
        low, high = (middle, high) if len(staying_ids(drive[:middle], scenario)) >= wanted else (low, middle)
    hint = f"; {wanted} stay for {low} frames" if low else "; give it more traffic, a longer warmup_s or a larger area"
    return (
        f"scenario '{scenario.name}': agents.vehicles: expected {wanted} cars or vans that stay in the area for all"
        f" {len(drive)} frames, found {found}{hint}"
    )
