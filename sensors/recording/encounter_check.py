"""Encounter check by rays: the first draw of an encounter that hides its conflict actor from the ego in time.

Conditions, tested with the LiDARs of the drive before anything of it is written:

* without reaction ego and conflict actor collide, before any other collision;
* the ego has fewer than `UNSEEN_POINTS` points on the conflict actor at every step until the time to collision is below
  the critical one: a latency of `LATENCY_S` and full braking at `BRAKING_MPS2`, `LATENCY_S + v / (2 * BRAKING_MPS2)` at
  speed v. Its LiDAR loses no beam at random here, so that of the drive has no more points;
* a helper has at least `SEEN_POINTS` points on it a second or more before that.

The time to collision is the time from an instant to the first contact of the two bodies in the rollout.
"""

import functools
import logging
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from sensors.frame import count_points
from sensors.presets import scenario_lidars
from sensors.recording.mounting import Mount, on_roadside, on_vehicle, place_roadside
from sensors.recording.static_scene import static_scene
from sensors.scan.lidar import scan_all
from sensors.scan.scene import RayScene
from sim.encounters import encounter_of, with_encounter
from sim.encounters.types import Ghost
from sim.errors import ScenarioError, complaint
from sim.files import write_file
from sim.geometry import wrap_angle
from sim.kept.files import kept_file
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.traffic.base import Actors
from sim.traffic.script import FIRST_ID, ScriptedTraffic
from sim.world.standing import standing

UNSEEN_POINTS = 5
SEEN_POINTS = 20
LATENCY_S = 0.3
BRAKING_MPS2 = 7.0
AHEAD_S = 1.0
"""Least lead of a helper's view of the conflict actor over the critical time, s."""

EGO_ID, CONFLICT_ID = FIRST_ID, FIRST_ID + 1

_MOST_S = 12.0
_CHECK_EVERY = 2

log = logging.getLogger(__name__)


class Proof(msgspec.Struct, frozen=True, kw_only=True):
    """Result of the check of one encounter; times in s, None for events that never happen.

    Attributes:
        holds: all conditions hold.
        reason: first failed condition: `no collision`, `other collision`, `seen early`, `not seen by a helper` or "".
        hit_s: time of the collision without reaction.
        hit: name of the first collision partner of the ego.
        critical_ttc_s: time to collision below which the ego cannot stop, at its speed then.
        ego_ttc_s: time to collision when the ego first has `UNSEEN_POINTS` points on the conflict actor.
        helper_ttc_s: time to collision when a helper first has `SEEN_POINTS` points on it.
        helper: name of that helper, `roadside` and its number for a unit.
        ego_points: most points of the ego on it before the critical time.
    """

    holds: bool
    reason: str
    hit_s: float | None = None
    hit: str = ""
    critical_ttc_s: float | None = None
    ego_ttc_s: float | None = None
    helper_ttc_s: float | None = None
    helper: str = ""
    ego_points: int = 0


class ProvenEncounter(msgspec.Struct, frozen=True, kw_only=True):
    """Proven encounter of a drive.

    Attributes:
        scenario: with the number of the draw, the agents and the area.
        proof: of the encounter without a control.
        control: result of the control; None without one.
        rejected: number of failed draws before, by reason.
        parameters: drawn values.
        ghosts: false objects: name, claiming helper, class, size, m, and track: time, s, x, y, m, yaw, rad.
    """

    scenario: Scenario
    proof: Proof
    control: Proof | None
    rejected: dict[str, int]
    parameters: dict[str, float]
    ghosts: tuple[dict[str, Any], ...] = ()


def with_proven_encounter(scenario: Scenario, seed: int) -> Scenario:
    """Return a scenario with the proven draw, agents and area of its encounter; others unchanged.

    The draw is that of `find_encounter`; a control itself is not proven.

    Raises:
        ScenarioError: no proof holds, or a value is out of its range.
    """
    if scenario.conflict is None or scenario.agents.named:
        return scenario
    draw, _, _ = _first_proven_draw(_uncontrolled(scenario), seed)
    return with_encounter(_with(scenario, draw=draw), seed)


def find_encounter(scenario: Scenario, seed: int) -> ProvenEncounter:
    """Return the first draw of a seed whose proof holds, with the control of the same draw.

    Raises:
        ScenarioError: no proof holds among `conflict.draws` draws, or a value is out of its range.
    """
    return _found(msgspec.json.encode(scenario), seed)


@functools.lru_cache(maxsize=64)
def _found(scenario_json: bytes, seed: int) -> ProvenEncounter:
    scenario = msgspec.json.decode(scenario_json, type=Scenario)
    if scenario.conflict is None:
        raise ScenarioError(complaint(scenario.name, "conflict", "one of an encounter", "none"))
    draw, proof, rejected = _first_proven_draw(_uncontrolled(scenario), seed)
    chosen = _with(scenario, draw=draw)
    encounter = encounter_of(chosen, seed)
    return ProvenEncounter(
        scenario=with_encounter(chosen, seed),
        proof=proof,
        control=prove_encounter(chosen, seed) if scenario.conflict.control else None,
        rejected=rejected,
        parameters=encounter.parameters,
        ghosts=tuple(_ghost(ghost, scenario.step_s) for ghost in encounter.ghosts),
    )


def _uncontrolled(scenario: Scenario) -> bytes:
    """Return the scenario as JSON without its control, which takes the draw of its encounter."""
    assert scenario.conflict is not None
    name = scenario.name.removesuffix(f"-{scenario.conflict.control}")
    return msgspec.json.encode(msgspec.structs.replace(_with(scenario, control=""), name=name))


@functools.lru_cache(maxsize=64)
def _first_proven_draw(scenario_json: bytes, seed: int) -> tuple[int, Proof, dict[str, int]]:
    """Return the first proven draw of a scenario without a control, its proof and the counts of failures by reason.

    It is proven once for all processes and later runs.
    """
    scenario = msgspec.json.decode(scenario_json, type=Scenario)
    lidars = msgspec.to_builtins(scenario_lidars(with_encounter(scenario, seed)))
    path = kept_file("encounters", ".json", __name__, scenario, seed, lidars)
    with suppress(OSError, msgspec.MsgspecError):
        return msgspec.json.decode(path.read_bytes(), type=tuple[int, Proof, dict[str, int]])
    found = _search_draws(scenario, seed)
    with suppress(OSError):  # a cache that cannot be written to costs time alone
        write_file(path, msgspec.json.encode(found))
    return found


def _search_draws(scenario: Scenario, seed: int) -> tuple[int, Proof, dict[str, int]]:
    spec = scenario.conflict
    assert spec is not None
    rejected: Counter[str] = Counter()
    for draw in range(spec.draw, spec.draw + spec.draws):
        proof = prove_encounter(_with(scenario, draw=draw), seed, hurry=True)
        if proof.holds:
            return draw, proof, dict(rejected)
        log.info("%s seed %d: draw %d is not used: %s", scenario.name, seed, draw, proof.reason)
        rejected[proof.reason] += 1
    found = ", ".join(f"{count} x {reason}" for reason, count in rejected.most_common())
    expected = f"values that hide the conflict in time in one of {spec.draws} draws of seed {seed}"
    raise ScenarioError(complaint(scenario.name, "conflict.parameters", expected, found))


def _ghost(ghost: Ghost, step_s: float) -> dict:
    claimed, times = ghost.actor, np.arange(0.0, _MOST_S + 0.5 * step_s, step_s)
    along = claimed.place(times)
    here = (along >= 0.0) & (along < claimed.path.length)
    place, heading, _ = claimed.path.at(along[here])
    track = np.column_stack([times[here], place[:, :2], wrap_angle(heading)]).round(3)
    return {
        "name": claimed.name,
        "claimed_by": ghost.claimed_by,
        "class": claimed.kind.label,
        "size": list(claimed.kind.size),
        "track": track.tolist(),
    }


def prove_encounter(scenario: Scenario, seed: int, *, hurry: bool = False) -> Proof:
    """Roll out an encounter without reaction and check its conditions by rays.

    Args:
        scenario: has a conflict; its control and its draw are used unchanged.
        hurry: stop at the first failed condition; later results stay None.
    """
    scenario = with_encounter(scenario, seed)
    drive = roll_out(scenario, seed)
    if drive.hit != "conflict":
        reason = "other collision" if drive.hit else "no collision"
        return Proof(holds=False, reason=reason, hit=drive.hit, hit_s=drive.hit_s)
    assert drive.hit_s is not None
    scene = static_scene(scenario, seed)
    counter = PointCounter(scene, scenario, seed, drive.steps)
    ttc, critical, limit = last_chance(drive, scenario.step_s)
    last = len(ttc) - 1
    fields: dict[str, Any] = {
        "hit_s": drive.hit_s,
        "hit": drive.hit,
        "critical_ttc_s": round(critical, 3),
    }
    # First the last second, in which the view opens, then every other step for short glimpses, then the rest.
    likely = [*range(limit, max(limit - 10, -1), -1), *range(max(limit - 10, 0), -1, -_CHECK_EVERY)]
    before = list(dict.fromkeys([*likely, *range(limit, -1, -1)]))
    if hurry and (early := next((n for step in before if (n := counter.points("ego", step)) >= UNSEEN_POINTS), 0)):
        return Proof(holds=False, reason="seen early", ego_points=early, **fields)
    points = {step: counter.points("ego", step) for step in before}
    fields["ego_points"] = max(points.values())
    seen = [step for step, count in sorted(points.items()) if count >= UNSEEN_POINTS]
    after = next((s for s in range(limit + 1, last + 1) if counter.points("ego", s) >= UNSEEN_POINTS), None)
    first = seen[0] if seen else after
    fields["ego_ttc_s"] = None if first is None else round(float(ttc[first]), 3)
    fields |= _first_helper(counter, ttc)
    helper_ttc = fields["helper_ttc_s"]
    if seen:
        return Proof(holds=False, reason="seen early", **fields)
    if helper_ttc is None or helper_ttc < fields["critical_ttc_s"] + AHEAD_S:
        return Proof(holds=False, reason="not seen by a helper", **fields)
    return Proof(holds=True, reason="", **fields)


def _first_helper(counter: "PointCounter", ttc: np.ndarray) -> dict[str, Any]:
    """Return name and time of the first helper with enough points."""
    for step in range(1, len(ttc), _CHECK_EVERY):
        for name in counter.helpers:
            if counter.points(name, step) >= SEEN_POINTS:
                return {"helper_ttc_s": round(float(ttc[step]), 3), "helper": name}
    return {"helper_ttc_s": None, "helper": ""}


@dataclass(frozen=True, slots=True, eq=False)
class Rollout:
    """Rollout of an encounter: actors of every step until one after the crash, and the crash of the ego."""

    steps: tuple[Actors, ...]
    hit_s: float | None
    hit: str


def last_chance(drive: Rollout, step_s: float) -> tuple[np.ndarray, float, int]:
    """Return (T,) times to the collision, s, the critical one, and the last step at which the ego can still stop."""
    assert drive.hit_s is not None
    last = round(drive.hit_s / step_s)
    row = drive.steps[0].row(EGO_ID)
    speed = np.array([float(np.hypot(*step.velocity[row])) for step in drive.steps[: last + 1]])
    ttc = drive.hit_s - step_s * np.arange(last + 1)
    critical = LATENCY_S + speed / (2.0 * BRAKING_MPS2)
    in_time = np.flatnonzero(ttc >= critical)
    limit = int(in_time[-1]) if len(in_time) else 0
    return ttc, float(critical[limit]), limit


def roll_out(scenario: Scenario, seed: int) -> Rollout:
    """Return the rollout of an encounter without any reaction.

    Args:
        scenario: with the agents of its encounter, see `sim.encounters.with_encounter`.
    """
    stand = standing(scenario, seed)
    with ScriptedTraffic(scenario, seed) as traffic:
        steps = [stand(traffic.actors).rounded()]  # as a drive has them
        while traffic.time_s < _MOST_S and not traffic.crashes:
            steps.append(stand(traffic.step()).rounded())
        steps.append(stand(traffic.step()).rounded())
        if not traffic.crashes:
            return Rollout(tuple(steps), None, "")
        time_s, *names = traffic.crashes[0]
        others = [name for name in names if name != "ego"]
        return Rollout(tuple(steps), time_s, others[0] if len(others) == 1 else "+".join(names))


class PointCounter:
    """Counter of the agents' points on the conflict actor, cached by agent and step."""

    def __init__(self, scene: RayScene, scenario: Scenario, seed: int, steps: Sequence[Actors]) -> None:
        self._scene, self._steps, self._seed = scene, steps, seed
        self._spec, _ = scenario_lidars(scenario)
        self._without_loss = msgspec.structs.replace(self._spec, dropoff_rate=0.0, dropoff_zero_intensity=0.0)
        self._mount = Mount(scenario.agents.mount_xyz_m, scenario.agents.mount_pitch_deg)
        self._units = {f"roadside {-u.agent_id}": u for u in place_roadside(scene, scenario.agents.roadside)}
        self.helpers = (*scenario.agents.named[1:], *self._units)
        self._known: dict[tuple[str, int], int] = {}

    def points(self, name: str, step: int) -> int:
        """Return the number of an agent's points on the conflict actor at a step."""
        if (name, step) not in self._known:
            self._known[name, step] = self._count(name, step)
        return self._known[name, step]

    def _count(self, name: str, step: int) -> int:
        now = self._steps[step]
        if CONFLICT_ID not in now.boxes.object_id:
            return 0
        unit = self._units.get(name)
        if unit is None and name not in now.name:
            return 0
        spec = self._without_loss if name == "ego" else self._spec if unit is None else unit.spec
        before = self._steps[step - 1] if step else None
        scene = self._scene.with_bodies(now, before, self._steps[step + 1], reach_s=0.5 * spec.period_s)
        rng = random_generator(self._seed, Stream.ENCOUNTER_CHECK, step)
        if unit is not None:
            sensor = on_roadside(unit, now.time_s, rng)
        else:
            agent_id = int(now.boxes.object_id[now.name.index(name)])
            sensor = on_vehicle(scene, now, agent_id, spec, self._mount, rng)
        return int(count_points(scan_all(scene, [sensor])[0], np.array([CONFLICT_ID]))[0])


def _with(scenario: Scenario, **changes: object) -> Scenario:
    assert scenario.conflict is not None
    return msgspec.structs.replace(scenario, conflict=msgspec.structs.replace(scenario.conflict, **changes))
