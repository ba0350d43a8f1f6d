"""Collective Perception Message of ETSI TS 103 324 V2.1.1 (2023-06): what it states, how finely, and what is left out.

Resolutions and ranges are those of the data elements of `PerceivedObject` in ETSI TS 102 894-2 V2.1.1, see `quantised`,
as ETSI documents its ASN.1 modules (forge.etsi.org/rep/ITS/asn1/cdd_ts102894_2). Nothing is encoded: sizes are those of
`sim.radio.cpm_bytes`.

Redundancy mitigation, off unless a rule is named: a sender leaves out what others told within the last second. Two of
the rules of ETSI TR 103 562 V2.1.1, which annex E of TS 103 324 names without numbers as ways to value information; the
values are those of the simulator Artery:

* `dynamics`: an object that since then moved by at most 4 m and changed its speed by at most 0.5 m/s;
* `distance`: an object that a station within 10 m of the sender told.

Senders hear each other without loss. An object is one that was told where that one stands by its stated motion.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dsrc.messages.message import Objects, near_pairs
from sim.boxes import Boxes
from sim.geometry import Array, wrap_angle
from sim.radio import cpm_bytes

RULES = ("dynamics", "distance")
"""Rules of redundancy mitigation."""
WINDOW_S = 1.0
"""Age up to which told objects count, s: `W_Redundancy`."""
_MOVED_M, _FASTER_MPS, _NEAR_M = 4.0, 0.5, 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Cpm:
    """One message.

    Attributes:
        time_s: instant of its objects, s.
        objects: N objects with velocities, world frame; `object_id` is the sender's number of each.
        rate: (N,) turn rates, rad/s.
        place: (2,) of the sender, world frame, m.
    """

    time_s: float
    objects: Objects
    rate: Array
    place: Array

    @property
    def bytes(self) -> int:
        """Size on air."""
        return cpm_bytes(len(self.objects))


def quantised(objects: Objects, rate: Array) -> tuple[Objects, Array]:
    """Return objects and their (N,) turn rates, rad/s, as a message states them.

    Data elements of ETSI TS 102 894-2 V2.1.1: `CartesianCoordinateLarge` 0.01 m, here from the world's origin in place
    of the sender; `VelocityComponentValue` 0.01 m/s, -163.82 to 163.81; `CartesianAngleValue` 0.1 degrees;
    `CartesianAngularVelocityComponentValue` 1 degree/s, to 254; `ObjectDimensionValue` 0.1 to 25.4 m in steps of 0.1;
    `ConfidenceLevel` 1 to 100 %. Values beyond are stated as out of range there, and as the last one within it here.

    Value n stands for the step that ends at n. Here values are rounded to the nearest: half a step of error at most, as
    that of a receiver who takes the middle of the step.
    """
    boxes = objects.boxes
    stated = Boxes(
        _steps(boxes.center, 0.01),
        _steps(boxes.size, 0.1, 0.1, 25.4),
        wrap_angle(_steps(boxes.yaw, np.radians(0.1))),
        boxes.label,
        boxes.object_id,
    )
    velocity = _steps(objects.velocity, 0.01, -163.82, 163.81)
    turning = _steps(rate, np.radians(1.0), -np.radians(254.0), np.radians(254.0))
    return Objects(stated, _steps(objects.score, 0.01, 0.01, 1.0), velocity), turning


def _steps(values: Array, step: float, low: float = -np.inf, high: float = np.inf) -> Array:
    return np.clip(np.rint(values / step) * step, low, high)


def redundant(rule: str, objects: Objects, place: Array, heard: Sequence[Cpm], time_s: float) -> NDArray[np.bool_]:
    """Return (N,) which objects a sender leaves out.

    Args:
        rule: of `RULES`; "" for none.
        objects: that it would tell.
        place: (2,) of the sender, world frame, m.
        heard: messages of others.
        time_s: the present, s.
    """
    found = np.zeros(len(objects), bool)
    for message in heard if rule else ():
        if time_s - message.time_s > WINDOW_S or (
            rule == "distance" and np.linalg.norm(message.place - place) > _NEAR_M
        ):
            continue
        told = message.objects
        moved = told.boxes.center.copy()
        moved[:, :2] += np.nan_to_num(told.velocity) * (time_s - message.time_s)
        same = near_pairs(objects.boxes, replace(told.boxes, center=moved))
        if rule == "dynamics":
            apart = np.linalg.norm(objects.boxes.center[:, None, :2] - told.boxes.center[None, :, :2], axis=2)
            speeds = (np.linalg.norm(one.velocity, axis=1) for one in (objects, told))
            faster = np.nan_to_num(np.abs(np.subtract.outer(*speeds)))
            same &= (apart <= _MOVED_M) & (faster <= _FASTER_MPS)
        found |= same.any(axis=1)
    return found


def told_at_once(
    found: Mapping[int, Objects], places: Mapping[int, Array], time_s: float, rule: str = "", exact: bool = False
) -> dict[int, Cpm]:
    """Return the messages of one instant before which nobody told anything: every object is new, and told.

    Args:
        found: objects of each sender, world frame; in this order they speak, and hear those before them.
        places: (2,) of each, m.
        time_s: the instant, s.
        rule: of redundancy mitigation, see `redundant`.
        exact: numbers are as fine as they are found, to tell what resolution costs.
    """
    messages: dict[int, Cpm] = {}
    for agent, objects in found.items():
        kept = objects[~redundant(rule, objects, places[agent], list(messages.values()), time_s)]
        still = np.zeros(len(kept))
        stated = (kept, still) if exact else quantised(kept, still)
        messages[agent] = Cpm(round(time_s, 3), *stated, places[agent])
    return messages


def placed(message: Cpm, moved: NDArray[np.float64]) -> Objects:
    """Return the objects of a message whose sender errs about where it is, by the (4, 4) transform of its world."""
    objects = message.objects
    return Objects(objects.boxes.transform(moved), objects.score, objects.velocity @ moved[:2, :2].T)
