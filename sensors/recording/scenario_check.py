"""Contract check of scenarios, of one's own in particular, as gymnasium's `check_env` of environments."""

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from sensors.frame import Frame
from sensors.presets import scenario_lidars
from sensors.recording.encounter_check import with_proven_encounter
from sensors.recording.record import record
from sim.catalog.load import load_scenario
from sim.errors import ScenarioError, UserError
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.world.build import build_world
from sim.world.standing import open_standing

FRAMES = 2


def check_scenario(scenario: Scenario | str | Path, seed: int | None = None) -> None:
    """Check that a scenario can be driven and recorded.

    Checked are its file, LiDARs, static world, traffic (ids, finite values, time, the same actors for the same seed)
    and the first frames: all agents present, each with points, some of them on other road users.

    Args:
        scenario: name, path or value.
        seed: of everything random; None for the scenario's.

    Raises:
        ScenarioError: one line per failure, which begins with the file where `scenario` is one.
    """
    given = scenario.name if isinstance(scenario, Scenario) else str(scenario)
    place = given if Path(given).exists() else f"scenario '{given}'"
    name = given
    try:
        loaded = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
        name = loaded.name
        failures = list(_failures(loaded, loaded.seed if seed is None else seed))
    except UserError as error:  # a part that cannot be made has its own line
        failures = [str(error)]
    if failures:
        lines = (line.removeprefix(f"{name}: ") for line in failures)
        raise ScenarioError("\n".join(line if line.startswith(place) else f"{place}: {line}" for line in lines))


def _failures(scenario: Scenario, seed: int) -> Iterator[str]:
    """Yield one line per broken rule."""
    if msgspec.convert(msgspec.to_builtins(scenario), Scenario) != scenario:
        yield "fields: expected the same scenario after writing and reading it, found another"
    scenario_lidars(scenario)
    scenario = with_proven_encounter(scenario, seed)
    world = build_world(scenario, seed)
    if not len(world.faces) or not np.isfinite(world.vertices).all():
        yield f"world: expected finite triangles, found {len(world.faces)} and {len(world.vertices)} corners"
        return
    with open_standing(scenario, seed) as traffic:
        first = traffic.actors
        recording = record(traffic, world, scenario, seed, FRAMES, scenario.step_s)
    with open_standing(scenario, seed) as again:
        if _bytes(again.actors) != _bytes(first):
            yield "traffic: expected the same actors for the same seed, found others"
    for index, actors in enumerate(recording.steps):
        yield from (f"traffic: step {index}: {line}" for line in _actor_failures(actors))
    times = np.diff([actors.time_s for actors in recording.steps])
    if not np.allclose(times, scenario.step_s):
        yield f"traffic: expected steps of {scenario.step_s:g} s, found {times.min():g} to {times.max():g} s"
    expected = scenario.agents.vehicles + len(scenario.agents.roadside)
    if len(recording.agent_ids) != expected:
        yield f"agents: expected {expected}, found {len(recording.agent_ids)}"
    for frame in recording:
        yield from (f"frame {frame.index}: {line}" for line in _frame_failures(frame))


def _actor_failures(actors: Actors) -> Iterator[str]:
    ids = actors.boxes.object_id
    if len(np.unique(ids)) != len(ids):
        yield "expected each id once, found some twice"
    if not np.isfinite(actors.boxes.array).all() or not np.isfinite(actors.velocity).all():
        yield "expected finite boxes and velocities, found nan or inf"


def _frame_failures(frame: Frame) -> Iterator[str]:
    for agent in frame.agents:
        if not len(agent.sweep):
            yield f"agent {agent.agent_id}: expected points, found none"
    if not len(frame.truth):
        yield "truth: expected road users within reach of the agents, found none"
    elif not (frame.points_on > 0).any():
        yield "points_on: expected points on other road users, found none"


def _bytes(actors: Actors) -> list[bytes]:
    return [actors.boxes.array.tobytes(), actors.boxes.object_id.tobytes(), actors.velocity.tobytes()]
