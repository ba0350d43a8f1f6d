"""Meeting of an episode: the contact, or the nearest pass, and how the ego and the other came to it."""

from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from dsrc.closed_loop.causes.cause import cause_of, first_steps
from dsrc.closed_loop.causes.episodes import sight_of
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.metrics.surrogate import times_to_collision
from dsrc.closed_loop.types import Tick
from sim.errors import UserError
from sim.traffic.base import Actors

BEFORE_S = 2.0
"""Time before the meeting at which an episode opens, s."""


@dataclass(slots=True, eq=False)
class Meeting:
    """Meeting of the ego with another road user in an episode of T steps.

    Attributes:
        row: step of the contact, or of the nearest pass.
        other_id: the road user; None where the ego meets nobody, or hits the world.
        name: `contact` or `nearest pass`.
        opens: step at which the page opens.
        gap_m: (T,) distance of the footprints; NaN without the other.
        ttc_s: (T,) time to collision at constant velocities; infinity for none within ten seconds.
        why: cause of a crash in one sentence, or why it is unknown; "" before `explain`, and without a crash.
        steps: first steps of sight, track and full braking by their names, after `explain`.
        explained: whether both are known.
    """

    row: int
    other_id: int | None
    name: str
    opens: int
    gap_m: NDArray[np.float64]
    ttc_s: NDArray[np.float64]
    why: str = ""
    steps: dict[str, int] = field(default_factory=dict)
    explained: bool = False

    @property
    def marks(self) -> dict[str, int]:
        """Steps by what happens in them."""
        return {**self.steps, self.name: self.row}

    def explain(self, log: EpisodeLog) -> None:
        """Find the cause and the first steps, which may build the world and cast rays."""
        known: dict[float, bool] = {}

        def in_sight(now: Actors, object_id: int) -> bool:
            # The cause and the steps ask for the same road user.
            if now.time_s not in known:
                known[now.time_s] = look(now, object_id)
            return known[now.time_s]

        try:
            look = sight_of(log)
            cause = cause_of(log, in_sight)
            self.why = "" if cause is None else cause.sentence
            if self.other_id is not None:
                found = first_steps(log, in_sight, self.other_id)
                names = {"first sight": found.sight, "first track": found.tracked, "first full brake": found.braked}
                self.steps = {name: step for name, step in names.items() if step is not None}
        except UserError as error:
            self.why = f"the cause is unknown: {error}"
        finally:
            self.explained = True


def meeting_of(log: EpisodeLog) -> Meeting:
    """Meeting of an episode with at least one step."""
    ego_id, contact = log.settings.ego_id, log.contact
    row = next((k for k, tick in enumerate(log.ticks) if tick.contact is not None), len(log) - 1)
    other = contact.other_id if contact is not None else None
    if contact is None:
        near = [_nearest(tick, ego_id) for tick in log.ticks]
        row = int(np.argmin([gap for gap, _ in near]))
        other = near[row][1]
    other = None if other is None or other < 0 else other
    gap_m, ttc_s = np.full(len(log), np.nan), np.full(len(log), np.nan)
    for k, tick in enumerate(log.ticks):
        boxes = tick.actors.boxes
        if other is None or not {other, ego_id} <= set(boxes.object_id.tolist()):
            continue
        own, its = (tick.actors.row(one) for one in (ego_id, other))
        pair = boxes[np.array([own, its])].bev_polygons()
        gap_m[k] = shapely.distance(*shapely.polygons(pair))
        velocity = tick.actors.velocity
        (ttc_s[k],) = times_to_collision(boxes[own : own + 1], velocity[own], boxes[its : its + 1], velocity[[its]])
    opens = max(row - round(BEFORE_S / log.actors.step_s), 0)
    return Meeting(row, other, "contact" if contact is not None else "nearest pass", opens, gap_m, ttc_s)


def _nearest(tick: Tick, ego_id: int) -> tuple[float, int | None]:
    """Distance of the ego's footprint to the nearest other, m, and its id; infinity and None without another."""
    boxes = tick.actors.boxes
    if ego_id not in boxes.object_id or len(boxes) < 2:
        return np.inf, None
    polygons = shapely.polygons(boxes.bev_polygons())
    away = np.where(boxes.object_id == ego_id, np.inf, shapely.distance(polygons[tick.actors.row(ego_id)], polygons))
    nearest = int(np.argmin(away))
    return float(away[nearest]), int(boxes.object_id[nearest])
