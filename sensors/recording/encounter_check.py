"""The proof by rays: an encounter is what it promises, or another one is drawn.

What is proven of an instance, with the LiDARs that its drive will have and before anything of it is written:

* without reaction ego and conflict actor collide, and nobody collides before them;
* the ego has fewer than `UNSEEN_POINTS` points on the conflict actor at every step until the time to collision is below
  the critical one: a latency of `LATENCY_S` and full braking at `BRAKING_MPS2`, `LATENCY_S + v / (2 * BRAKING_MPS2)` at
  speed v. Its LiDAR loses no beam at random here, so the drive's, which may lose some, has no more;
* a helper has at least `SEEN_POINTS` points on it a second or more before that.

The time to collision is that of the rollout, from an instant to the first contact of the two bodies.
"""

import functools
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from sensors.frame import count_points
from sensors.presets import scenario_lidars
from sensors.recording.mounting import Mount, on_roadside, on_vehicle, place_roadside
from sensors.scan.lidar import scan_all
from sensors.scan.scene import RayScene
from sim.encounters import instance_of, laid_out
from sim.encounters.types import Ghost
from sim.errors import ScenarioError, complaint
from sim.geometry import wrap_angle
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.traffic.script import FIRST_ID, ScriptedTraffic

UNSEEN_POINTS = 5
SEEN_POINTS = 20
LATENCY_S = 0.3
BRAKING_MPS2 = 7.0
AHEAD_S = 1.0
"""How much earlier than the critical time a helper must see the conflict actor, s."""

EGO_ID, CONFLICT_ID = FIRST_ID, FIRST_ID + 1

_MOST_S = 12.0
_LOOK_EVERY = 2

log = logging.getLogger(__name__)


class Proof(msgspec.Struct, frozen=True, kw_only=True):
    """What the rays say about one instance; times in s, None for what never happens.

    Attributes:
        holds: it is what it promises.
        reason: why not: `no collision`, `other collision`, `seen early`, `not seen by a helper` or "".
        hit_s: time of the collision without reaction.
        hit: name of the first that the ego collides with.
        critical_ttc_s: time to collision from which on the ego cannot stop any more, at its speed then.
        ego_ttc_s: time to collision when the ego first has `UNSEEN_POINTS` points on the conflict actor.
        helper_ttc_s: time to collision when a helper first has `SEEN_POINTS` points on it.
        helper: name of that helper, `roadside` and its number for a unit.
        ego_points: most points that the ego has before the critical time.
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


class Settled(msgspec.Struct, frozen=True, kw_only=True):
    """An encounter that a drive can be made of.

    Attributes:
        scenario: with the number of the draw, the agents and the area.
        proof: of the instance without a control.
        control: what the rays say about the control; None without one.
        rejected: how many draws failed before, by reason.
        parameters: the drawn values.
        ghosts: what is claimed and is not there: name, helper, class, size, m, and track: time, s, x, y, m, yaw, rad.
    """

    scenario: Scenario
    proof: Proof
    control: Proof | None
    rejected: dict[str, int]
    parameters: dict[str, float]
    ghosts: tuple[dict[str, Any], ...] = ()


def settled(scenario: Scenario, seed: int) -> Scenario:
    """Return a scenario as it is driven: one with a conflict with its proven draw, agents and area, others as they are.

    Raises:
        ScenarioError: see `settle`.
    """
    if scenario.conflict is None or scenario.agents.named:
        return scenario
    return settle(scenario, seed).scenario


def settle(scenario: Scenario, seed: int) -> Settled:
    """Find the first draw of a seed whose proof holds; a control is that of the same draw.

    Args:
        scenario: has a conflict.
        seed: of the draws.

    Raises:
        ScenarioError: none of `conflict.draws` draws keeps the promise, or a value is out of its range.
    """
    return _settled(msgspec.json.encode(scenario), seed)


@functools.lru_cache(maxsize=64)
def _settled(scenario_json: bytes, seed: int) -> Settled:
    scenario = msgspec.json.decode(scenario_json, type=Scenario)
    if scenario.conflict is None:
        raise ScenarioError(complaint(scenario.name, "conflict", "one of an encounter", "none"))
    draw, proof, rejected = _first_that_holds(msgspec.json.encode(_with(scenario, control="")), seed)
    chosen = _with(scenario, draw=draw)
    instance = instance_of(chosen, seed)
    return Settled(
        scenario=laid_out(chosen, seed),
        proof=proof,
        control=prove(chosen, seed) if scenario.conflict.control else None,
        rejected=rejected,
        parameters=instance.parameters,
        ghosts=tuple(_ghost(ghost, scenario.step_s) for ghost in instance.ghosts),
    )


@functools.lru_cache(maxsize=64)
def _first_that_holds(scenario_json: bytes, seed: int) -> tuple[int, Proof, dict[str, int]]:
    """Return the first draw of a scenario without a control that holds, its proof and the reasons of those before."""
    scenario = msgspec.json.decode(scenario_json, type=Scenario)
    spec = scenario.conflict
    assert spec is not None
    rejected: Counter[str] = Counter()
    for draw in range(spec.draw, spec.draw + spec.draws):
        proof = prove(_with(scenario, draw=draw), seed, hurry=True)
        if proof.holds:
            return draw, proof, dict(rejected)
        log.info("%s seed %d: draw %d is not used: %s", scenario.name, seed, draw, proof.reason)
        rejected[proof.reason] += 1
    found = ", ".join(f"{count} x {reason}" for reason, count in rejected.most_common())
    expected = f"values of which one of {spec.draws} draws of seed {seed} proves to hide the conflict in time"
    raise ScenarioError(complaint(scenario.name, "conflict.parameters", expected, found))


def _ghost(ghost: Ghost, step_s: float) -> dict:
    claimed, times = ghost.actor, np.arange(0.0, _MOST_S + 0.5 * step_s, step_s)
    along = claimed.place(times)
    here = (along >= 0.0) & (along < claimed.way.length)
    place, heading, _ = claimed.way.at(along[here])
    track = np.column_stack([times[here], place[:, :2], wrap_angle(heading)]).round(3)
    return {
        "name": claimed.name,
        "claimed_by": ghost.claimed_by,
        "class": claimed.kind.label,
        "size": list(claimed.kind.size),
        "track": track.tolist(),
    }


def prove(scenario: Scenario, seed: int, *, hurry: bool = False) -> Proof:
    """Roll an encounter out without any reaction and cast the rays that decide about it.

    Args:
        scenario: has a conflict; its control and its draw are taken as they are.
        seed: of the drive.
        hurry: stop at the first thing that fails; what would be found out after it stays None.
    """
    from sim.world.build import build_world

    scenario = laid_out(scenario, seed)
    drive = _roll_out(scenario, seed)
    if drive.hit != "conflict":
        reason = "other collision" if drive.hit else "no collision"
        return Proof(holds=False, reason=reason, hit=drive.hit, hit_s=drive.hit_s)
    assert drive.hit_s is not None
    scene = RayScene(build_world(scenario, seed))
    look = _Lookout(scene, scenario, seed, drive.steps)
    last = round(drive.hit_s / scenario.step_s)
    row = drive.steps[0].row(EGO_ID)
    speed = np.array([float(np.hypot(*step.velocity[row])) for step in drive.steps[: last + 1]])
    ttc = drive.hit_s - scenario.step_s * np.arange(last + 1)
    critical = LATENCY_S + speed / (2.0 * BRAKING_MPS2)
    in_time = np.flatnonzero(ttc >= critical)
    limit = int(in_time[-1]) if len(in_time) else 0
    said: dict[str, Any] = {"hit_s": drive.hit_s, "hit": drive.hit, "critical_ttc_s": round(float(critical[limit]), 3)}
    # First the last second, in which sight opens, then every other step for what is glimpsed in passing, then the rest.
    likely = [*range(limit, max(limit - 10, -1), -1), *range(max(limit - 10, 0), -1, -_LOOK_EVERY)]
    before = list(dict.fromkeys([*likely, *range(limit, -1, -1)]))
    if hurry and (early := next((n for step in before if (n := look.points("ego", step)) >= UNSEEN_POINTS), 0)):
        return Proof(holds=False, reason="seen early", ego_points=early, **said)
    points = {step: look.points("ego", step) for step in before}
    said["ego_points"] = max(points.values())
    seen = [step for step, count in sorted(points.items()) if count >= UNSEEN_POINTS]
    after = next((s for s in range(limit + 1, last + 1) if look.points("ego", s) >= UNSEEN_POINTS), None)
    first = seen[0] if seen else after
    said["ego_ttc_s"] = None if first is None else round(float(ttc[first]), 3)
    said |= _first_helper(look, ttc)
    helper_ttc = said["helper_ttc_s"]
    if seen:
        return Proof(holds=False, reason="seen early", **said)
    if helper_ttc is None or helper_ttc < said["critical_ttc_s"] + AHEAD_S:
        return Proof(holds=False, reason="not seen by a helper", **said)
    return Proof(holds=True, reason="", **said)


def _first_helper(look: "_Lookout", ttc: np.ndarray) -> dict[str, Any]:
    """Return when which helper first has enough points, looking forwards."""
    for step in range(1, len(ttc), _LOOK_EVERY):
        for name in look.helpers:
            if look.points(name, step) >= SEEN_POINTS:
                return {"helper_ttc_s": round(float(ttc[step]), 3), "helper": name}
    return {"helper_ttc_s": None, "helper": ""}


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    """A rollout: the actors of every step, one more than up to the crash, and the crash of the ego."""

    steps: tuple[Actors, ...]
    hit_s: float | None
    hit: str


def _roll_out(scenario: Scenario, seed: int) -> _Drive:
    with ScriptedTraffic(scenario, seed) as traffic:
        steps = [traffic.actors.rounded()]  # as a drive has them
        while traffic.time_s < _MOST_S and not traffic.crashes:
            steps.append(traffic.step().rounded())
        steps.append(traffic.step().rounded())
        if not traffic.crashes:
            return _Drive(tuple(steps), None, "")
        time_s, *names = traffic.crashes[0]
        others = [name for name in names if name != "ego"]
        return _Drive(tuple(steps), time_s, others[0] if len(others) == 1 else "+".join(names))


class _Lookout:
    """Counts the points that agents have on the conflict actor."""

    def __init__(self, scene: RayScene, scenario: Scenario, seed: int, steps: Sequence[Actors]) -> None:
        self._scene, self._steps, self._seed = scene, steps, seed
        self._spec, _ = scenario_lidars(scenario)
        self._without_loss = msgspec.structs.replace(self._spec, dropoff_rate=0.0, dropoff_zero_intensity=0.0)
        self._mount = Mount(scenario.agents.mount_xyz_m, scenario.agents.mount_pitch_deg)
        self._units = {f"roadside {-u.agent_id}": u for u in place_roadside(scene, scenario.agents.roadside)}
        self.helpers = (*scenario.agents.named[1:], *self._units)
        self._known: dict[tuple[str, int], int] = {}

    def points(self, name: str, step: int) -> int:
        """Return how many points an agent has on the conflict actor at a step."""
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
        rng = np.random.default_rng([self._seed, step])
        if unit is not None:
            sensor = on_roadside(unit, now.time_s, rng)
        else:
            agent_id = int(now.boxes.object_id[now.name.index(name)])
            sensor = on_vehicle(scene, now, agent_id, spec, self._mount, rng)
        return int(count_points(scan_all(scene, [sensor])[0], np.array([CONFLICT_ID]))[0])


def _with(scenario: Scenario, **changes: Any) -> Scenario:
    assert scenario.conflict is not None
    return msgspec.structs.replace(scenario, conflict=msgspec.structs.replace(scenario.conflict, **changes))
