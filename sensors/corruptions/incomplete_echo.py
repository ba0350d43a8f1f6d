"""Incomplete echo: missing points on dark, glossy vehicles, which return too little light.

| severity                                   | 1  | 2  | 3  | 4  | 5  |
|--------------------------------------------|----|----|----|----|----|
| share of the points on vehicles lost, %    | 25 | 50 | 75 | 85 | 95 |

Of the n points on vehicles `int(share n)` are lost, the weakest returns first: dark paint before light paint, panels at
grazing incidence before those seen squarely, plates and reflectors last; so dark cars are gone when light ones still
have half their points. The returned light follows from the intensity, or else from material and angle of incidence
(`receiver.target_power`); speckle, a gamma law of 4 independent cells, blurs the order, and alone decides where both
are unknown. Points lost at a severity are lost at the next.

The shares of levels 3 to 5 are Robo3D's light, moderate and heavy; there points are lost at random. Points on vehicles
follow from ids and materials; a frame adds the classes of its objects and, for files without ids, their boxes
(`in_frame`). Bicycles and motorcycles count, people do not. A cloud without any of these keeps all points, with a
warning.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.corruptions.physics.receiver import target_power
from sensors.corruptions.physics.vehicles import note_unlabelled, points_on_vehicles
from sensors.frame import Frame
from sensors.sweep import UNKNOWN_MATERIAL, Sweep
from sim.mesh.materials import material_index

_SPECKLE_CELLS = 4.0
_LEAST_BRIGHTNESS = 1e-3
_OF_PEOPLE = tuple(material_index(name) for name in ("skin", "hair", "cloth_light", "cloth_dark"))


class IncompleteEcho(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        share: of the points on vehicles that are lost.
    """

    LEVELS: ClassVar = {"share": (0.25, 0.50, 0.75, 0.85, 0.95)}
    RANGES: ClassVar = {"share": (0.0, 1.0)}

    share: float = 0.75


def corrupt(
    sweep: Sweep,
    settings: IncompleteEcho,
    rng: np.random.Generator,
    on_vehicle: NDArray[np.bool_] | None = None,
) -> Sweep:
    """Remove the weakest returns on vehicles; the others are unchanged, in order.

    Args:
        on_vehicle: (P,) mask of points on vehicles; default: objects without a person's materials.
    """
    if on_vehicle is None:
        note_unlabelled(sweep, "ids of objects, or a frame with their boxes (corrupt_frame)")
        on_vehicle = on_vehicles(sweep)
    on = np.flatnonzero(on_vehicle)
    speckle = rng.gamma(_SPECKLE_CELLS, 1.0, len(on))
    lost = int(settings.share * len(on))
    if lost == 0:
        return sweep
    reach = sweep[on].range.astype(np.float64)
    # Relative to a white surface at normal incidence.
    brightness = np.maximum(target_power(sweep[on], reach) * reach**2, _LEAST_BRIGHTNESS) * speckle
    kept = np.ones(len(sweep), bool)
    kept[on[np.argsort(brightness, kind="stable")[:lost]]] = False
    return sweep[kept]


def in_frame(frame: Frame, row: int, settings: IncompleteEcho, rng: np.random.Generator) -> Sweep:
    """Return the sweep of the agent in a row of `frame.agents`, vehicles by the frame's truth."""
    return corrupt(frame.agents[row].sweep, settings, rng, points_on_vehicles(frame, row))


def on_vehicles(sweep: Sweep) -> NDArray[np.bool_]:
    """Return the (P,) mask of points on objects without a person's materials."""
    of_person = np.zeros(UNKNOWN_MATERIAL + 1, bool)
    of_person[list(_OF_PEOPLE)] = True
    return (sweep.object_id >= 0) & ~of_person[sweep.material]
