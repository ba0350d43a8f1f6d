"""Corruption of sweeps and frames by kind, severity and family, of all agents or of some (`CorruptedAgents`).

Weather is shared: all agents of a frame are in the same fog, whose strength drifts slowly over a drive (`weather`).
Faults are each sensor's own. An agent's sweep under a corruption is the same whoever else is corrupted. Random streams
are those of `sim.streams`. Published models have no time: they draw anew for every frame.
"""

from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from sensors.corruptions.physics.weather import strength, weather_rng
from sensors.corruptions.registry import CLEAN, CORRUPTIONS, Corruption, Family, require_corruption
from sensors.frame import AgentFrame, Frame
from sensors.sweep import ADDED, Sweep
from sim.errors import DataError, SettingsError, complaint, warn_deprecated
from sim.streams import Stream, derived_seed, random_generator

EVERYONE: Literal["all"] = "all"

AgentGroup = Literal["all", "ego", "helpers", "vehicles", "roadside"]
"""Agents by a word: all, the ego alone, all but the ego, vehicles, or roadside units."""

CorruptedAgents = AgentGroup | tuple[int, ...]
"""Agents whose sweeps are corrupted: a group, or those of some ids. Weather is everywhere by nature: weather at some
agents alone is a counterfactual, what it does to these sensors and to nothing else."""


_WORDS: dict[str, AgentGroup] = {word: word for word in get_args(AgentGroup)}
AGENTS_TEXT = "all, ego, helpers, vehicles, roadside or ids of agents"
"""What names agents, for messages."""


def corrupt(sweep: Sweep, kind: str, severity: int, rng: np.random.Generator, family: Family = "physical") -> Sweep:
    """Return the sweep under a corruption, its lost points counted in `Sweep.lost`.

    Args:
        kind: key of `CORRUPTIONS`, or `clean`.
        severity: 1 to 5; 3 is the paper's.

    Raises:
        SettingsError: an unknown kind, severity or family, or a kind that acts on frames: see `corrupt_frame`.
        DataError: the sweep lacks what the corruption needs, such as rings, or has invalid points.
    """
    require_corruption(kind, severity, family)
    if kind == CLEAN:
        return sweep
    _require_points(sweep)
    corruption = CORRUPTIONS[kind]
    apply = corruption.apply if family == "physical" else corruption.paper_apply
    if apply is None:
        raise SettingsError(f"corruption '{kind}' acts on whole frames: use corrupt_frame")
    return count_lost(sweep, apply(sweep, corruption.settings_of(family).severity(severity), rng))


def corrupt_frame(
    frame: Frame,
    kind: str,
    severity: int,
    seed: int,
    family: Family = "physical",
    *,
    ego_id: int | None = None,
    corrupted_agents: CorruptedAgents = EVERYONE,
    settings: Any = None,
    who: CorruptedAgents | None = None,
) -> Frame:
    """Corrupt the sweeps of the agents of a frame; ground truth and its point counts stay.

    Args:
        kind: key of `CORRUPTIONS`, or `clean`.
        severity: 1 to 5.
        seed: of the drive; frames may be corrupted in any order.
        ego_id: agent without errors of pose and clock, and the ego of `corrupted_agents`; None for the first vehicle in
            the order of the folders, else the first agent.
        corrupted_agents: agents whose sweeps are corrupted.
        settings: of the corruption, in place of those of the severity; weather drifts about them.
        who: former name of `corrupted_agents`.

    Raises:
        SettingsError: an unknown kind, severity or family, or `corrupted_agents` names nobody that the kind can
            corrupt.
        DataError: an id of `corrupted_agents` is no agent, or a sweep lacks what the corruption needs or has invalid
            points; the message names the agent.
    """
    if who is not None:
        warn_deprecated("who", "corrupted_agents")
        corrupted_agents = who
    require_corruption(kind, severity, family)
    require_agents(kind, corrupted_agents)
    if kind == CLEAN:
        return frame
    corruption = CORRUPTIONS[kind]
    if settings is None:
        settings = corruption.settings_of(family).severity(severity)
    if corruption.weather and family == "physical":
        settings = settings.scaled(strength(seed, kind, frame.time_s))
    shared = corruption.weather and corruption.in_frame is not None and family == "physical"
    ego = _ego_row(frame.agents, ego_id)
    chosen = _rows(frame, corrupted_agents, ego) - ({ego} if corruption.spares_ego else set())
    sweeps = []
    for row, agent in enumerate(frame.agents):
        if row not in chosen:
            sweeps.append(agent.sweep)
            continue
        own = corruption_rng(seed, kind, frame.index, agent.agent_id, family)
        rng = weather_rng(seed, kind) if shared else own
        try:
            _require_points(agent.sweep)
            sweeps.append(count_lost(agent.sweep, _applied(corruption, family, frame, row, settings, rng)))
        except DataError as error:
            raise DataError(f"frame {frame.index}: agent {agent.agent_id}: {error}") from None
    return frame.with_sweeps(sweeps)


def parse_agents(text: str) -> CorruptedAgents:
    """Return the `CorruptedAgents` of the word of a group or ids between commas, as `1003,-1`.

    Raises:
        SettingsError: the text is none of these.
    """
    word = _WORDS.get(text)
    if word is not None:
        return word
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        expected = f"{AGENTS_TEXT}, such as 1003,-1"
        raise SettingsError(complaint("corruption", "corrupted_agents", expected, text)) from None


def require_agents(kind: str, agents: CorruptedAgents) -> None:
    """Raise SettingsError unless `agents` is a group or ids, and the kind can corrupt it."""
    where = f"corruption '{kind}'"
    if agents not in _WORDS and (isinstance(agents, str) or len(agents) == 0):
        raise SettingsError(complaint(where, "corrupted_agents", AGENTS_TEXT, agents))
    if agents == "ego" and kind != CLEAN and CORRUPTIONS[kind].spares_ego:
        raise SettingsError(
            complaint(where, "corrupted_agents", "helpers, as it is an error relative to the ego", agents)
        )


def in_group(agents: CorruptedAgents, agent_id: int, ego_id: int) -> bool:
    """Return whether an agent is one of those named; ids of roadside units are negative."""
    if not isinstance(agents, str):
        return agent_id in agents
    if agents in ("vehicles", "roadside"):
        return (agent_id < 0) == (agents == "roadside")
    return agents == "all" or (agent_id == ego_id) == (agents == "ego")


def _rows(frame: Frame, agents: CorruptedAgents, ego: int) -> set[int]:
    """Return the rows of the agents whose sweeps are corrupted."""
    ids = [agent.agent_id for agent in frame.agents]
    if isinstance(agents, str):
        return {row for row, one in enumerate(ids) if in_group(agents, one, ids[ego])}
    for one in agents:
        if one not in ids:
            raise DataError(complaint(f"frame {frame.index}", "corrupted_agents", f"ids among the agents {ids}", one))
    return {ids.index(one) for one in agents}


def corruption_rng(seed: int, kind: str, index: int, agent_id: int, family: Family = "physical") -> np.random.Generator:
    """Return the random generator of one agent's sweep in one frame."""
    when = 0 if CORRUPTIONS[kind].steady and family == "physical" else 1 + index
    return random_generator(seed, Stream.CORRUPTION, kind, when, agent_id)


def drive_seed(seed: int, drive: str) -> int:
    """Return the seed of a drive by its name: each drive of a run has its own weather and faults."""
    return derived_seed(seed, Stream.CORRUPTION_SEED, drive)


def _require_points(sweep: Sweep) -> None:
    """Raise DataError unless coordinates are finite and intensities in [0, 1], not of 8 bits."""
    if len(sweep) == 0:
        return
    if not np.isfinite(sweep.points).all():
        bad = int(np.count_nonzero(~np.isfinite(sweep.points).all(axis=1)))
        raise DataError(complaint("sweep", "points", "finite coordinates", f"nan or inf in {bad} of {len(sweep)}"))
    low, high = float(sweep.intensity.min()), float(sweep.intensity.max())
    if not (low >= 0.0 and high <= 1.0):
        expected = "0 to 1 (divide those of 8 bits by 255)"
        raise DataError(complaint("sweep", "intensity", expected, f"{low:g} to {high:g}"))


def _applied(
    corruption: Corruption, family: Family, frame: Frame, row: int, settings: object, rng: np.random.Generator
) -> Sweep:
    """Return the sweep of the agent in a row of the frame, by the frame-level model where the family has one."""
    in_frame = corruption.in_frame if family == "physical" else corruption.paper_in_frame
    if in_frame is not None:
        return in_frame(frame, row, settings, rng)
    apply = corruption.apply if family == "physical" else corruption.paper_apply
    if apply is None:
        raise KeyError(family)
    return apply(frame.agents[row].sweep, settings, rng)


def count_lost(before: Sweep, after: Sweep) -> Sweep:
    """Return the corrupted sweep with its lost surface points counted in `lost`; TypeError unless it is a sweep."""
    if not isinstance(after, Sweep):
        raise TypeError(f"expected a Sweep, found {type(after).__name__}")
    lost = before.lost + max(0, surface_points(before) - surface_points(after))
    return after if after.lost == lost else replace(after, lost=lost)


def surface_points(sweep: Sweep) -> int:
    """Return the number of points on surfaces, added ones left out."""
    return int(np.count_nonzero(sweep.object_id != ADDED))


def ego_of(frame: Frame) -> int:
    """Return the id of the ego where nobody is named: the first vehicle in the order of the folders, else agent."""
    return frame.agents[_ego_row(frame.agents, None)].agent_id


def _ego_row(agents: tuple[AgentFrame, ...], ego_id: int | None) -> int:
    """Return the row of the ego; -1 if it is not an agent."""
    if ego_id is None:
        return next((row for row, agent in enumerate(agents) if agent.kind == "vehicle"), 0)
    return next((row for row, agent in enumerate(agents) if agent.agent_id == ego_id), -1)
