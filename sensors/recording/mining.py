"""Encounters mined from a map: which of its conflicts hide somebody until braking is too late, proven by rays.

A candidate is refused by lines of sight through the world of its place before its own world is made and swept.
"""

from collections.abc import Sequence
from contextlib import suppress

import msgspec
import numpy as np

from sensors.recording.encounter_check import CONFLICT_ID, EGO_ID, Rollout, last_chance, prove_encounter, roll_out
from sensors.recording.static_scene import static_scene
from sensors.scan.line_of_sight import seen_share
from sensors.scan.scene import RayScene
from sim.catalog.conflicts import Candidate
from sim.encounters import encounter_of, with_encounter
from sim.encounters.own import REACH_M
from sim.encounters.types import ScriptedActor
from sim.errors import ScenarioError
from sim.files import write_file
from sim.kept.files import kept_file
from sim.scenario import Scenario

PROVEN = "proven"

_DRAWS = 3
_EVERY = 2
_SEEN = 0.2
"""Share of an object's points in sight from which on a sweep would have hit it."""
_ROOF_M = 0.4
_HEIGHTS_M = (0.5, 1.2)
_ABOVE_M = 30.0


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """Judgement of a candidate.

    Attributes:
        kind: of the conflict.
        hidden_by: what hides it.
        place: id of the junction or edge.
        verdict: `proven`, else why not.
        hidden_s: how long a helper sees the conflict actor and the ego does not, s; None where it is not proven.
        helper: the first that sees it.
        scenario: of the proven draw; None else.
    """

    kind: str
    hidden_by: str
    place: str
    verdict: str
    hidden_s: float | None = None
    helper: str = ""
    scenario: Scenario | None = None


def judge(place: Sequence[Candidate], base: Scenario, seed: int) -> list[Finding]:
    """Return the findings of the candidates of one place, which share its world; known ones are not proven again."""
    return [_judged(one, base, seed) for one in place]


def _judged(one: Candidate, base: Scenario, seed: int) -> Finding:
    if one.scenario is None:
        return _finding(one, "road too short")
    path = kept_file("encounters", ".json", __name__, one.scenario, seed, "mined")
    with suppress(OSError, msgspec.MsgspecError):
        return msgspec.json.decode(path.read_bytes(), type=Finding)
    found = _proven(one, base, one.scenario, seed)
    with suppress(OSError):  # a cache that cannot be written to costs time alone
        write_file(path, msgspec.json.encode(found))
    return found


def _proven(one: Candidate, base: Scenario, scenario: Scenario, seed: int) -> Finding:
    x, y = one.xy
    area = (round(x - REACH_M, 1), round(y - REACH_M, 1), round(x + REACH_M, 1), round(y + REACH_M, 1))
    network = msgspec.structs.replace(base.network, area_m=area)
    agents = msgspec.structs.replace(base.agents, roadside=())
    verdict = ""
    for draw in range(_DRAWS):
        assert scenario.conflict is not None
        drawn = msgspec.structs.replace(scenario, conflict=msgspec.structs.replace(scenario.conflict, draw=draw))
        try:
            layout = encounter_of(drawn, seed).layout
        except ScenarioError as error:
            return _finding(one, "in the way" if ".placed[" in str(error) else "road too short")
        if min(actor.start_m for actor in layout.actors[:2]) < 0.0:  # they would appear on their way
            return _finding(one, "road too short")
        drive = roll_out(with_encounter(drawn, seed), seed)
        if drive.hit != "conflict":
            verdict = "other collision" if drive.hit else "no collision"
            continue
        scene = static_scene(msgspec.structs.replace(base, network=network, agents=agents), seed)
        if any(_stands_in(actor, scene) for actor in layout.actors[1:]):
            return _finding(one, "no room")
        if _seen_early(drive, scene, base.step_s):
            verdict = "seen early"
            continue
        proof = prove_encounter(drawn, seed, hurry=True)
        verdict = proof.reason
        if proof.holds:
            assert proof.helper_ttc_s is not None
            hidden_s = round(proof.helper_ttc_s - (proof.ego_ttc_s or 0.0), 2)
            return _finding(one, PROVEN, hidden_s=hidden_s, helper=proof.helper, scenario=drawn)
    return _finding(one, verdict)


def _finding(one: Candidate, verdict: str, **fields: object) -> Finding:
    return Finding(kind=one.kind, hidden_by=one.hidden_by, place=one.place, verdict=verdict, **fields)  # type: ignore[arg-type]


def _seen_early(drive: Rollout, scene: RayScene, step_s: float) -> bool:
    """Return whether the ego has the conflict actor in sight while it could still stop, by lines of sight."""
    _, _, limit = last_chance(drive, step_s)
    for now in (drive.steps[step] for step in range(limit, -1, -_EVERY)):
        if CONFLICT_ID not in now.boxes.object_id:
            continue
        row = now.row(EGO_ID)
        eye = now.boxes.center[row] + np.array([0.0, 0.0, 0.5 * now.boxes.size[row, 2] + _ROOF_M])
        share = seen_share(scene, now.boxes, eye[None], [EGO_ID], np.array([now.row(CONFLICT_ID)]))
        if share[0, 0] >= _SEEN:
            return True
    return False


def _stands_in(one: ScriptedActor, scene: RayScene) -> bool:
    """Return whether a road user stands at the start in something of the static world, or below it."""
    if one.place(0.0) != one.place(0.5):
        return False
    place, heading, _ = one.path.at(one.place(0.0))
    length, width, _ = one.kind.size
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    left = np.array([-ahead[1], ahead[0], 0.0])
    corners = np.array(
        [place + 0.5 * (a * length * ahead + b * width * left) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    )
    up = np.array([0.0, 0.0, 1.0])
    start = np.concatenate([*(corners + height * up for height in _HEIGHTS_M), place[None] + _HEIGHTS_M[0] * up])
    around = np.roll(corners, -1, axis=0)
    end = np.concatenate([*(around + height * up for height in _HEIGHTS_M), place[None] + _ABOVE_M * up])
    far = np.linalg.norm(end - start, axis=1)
    hits = scene.cast(start, (end - start) / far[:, None], float(far.max()))
    return bool(((hits.face >= 0) & (hits.distance < far)).any())
