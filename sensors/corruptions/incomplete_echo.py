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
(`in_frame`). Bicycles and motorcycles count, people do not.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.corruptions.physics.receiver import target_power
from sensors.frame import Frame
from sensors.sweep import UNKNOWN_MATERIAL, Sweep
from sim.boxes import CLASSES
from sim.mesh.materials import material_index

SHARE = (0.25, 0.50, 0.75, 0.85, 0.95)

_SPECKLE_CELLS = 4.0
_LEAST_BRIGHTNESS = 1e-3
_MARGIN_M = 0.1
_OF_PEOPLE = tuple(material_index(name) for name in ("skin", "hair", "cloth_light", "cloth_dark"))


class IncompleteEcho(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        share: of the points on vehicles that are lost.
    """

    LEVELS: ClassVar = {"share": SHARE}
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
        sweep: any sweep.
        settings: of the corruption.
        rng: draws the speckle.
        on_vehicle: (P,) mask of points on vehicles; default: objects without a person's materials.
    """
    on = np.flatnonzero(_on_vehicles(sweep) if on_vehicle is None else on_vehicle)
    speckle = rng.gamma(_SPECKLE_CELLS, 1.0, len(on))
    lost = int(settings.share * len(on))
    if lost == 0:
        return sweep
    brightness = np.maximum(_brightness(sweep[on]), _LEAST_BRIGHTNESS) * speckle
    kept = np.ones(len(sweep), bool)
    kept[on[np.argsort(brightness, kind="stable")[:lost]]] = False
    return sweep[kept]


def in_frame(frame: Frame, row: int, settings: IncompleteEcho, rng: np.random.Generator) -> Sweep:
    """Return the sweep of the agent in a row of `frame.agents`, vehicles by the frame's truth."""
    sweep = frame.agents[row].sweep
    ours = frame.truth.label != CLASSES.index("pedestrian")
    vehicles = frame.truth[ours]
    if (sweep.object_id >= 0).any():
        return corrupt(sweep, settings, rng, np.isin(sweep.object_id, vehicles.object_id))
    points, inside = sweep.world_points, np.zeros(len(sweep), bool)
    for index, velocity in enumerate(frame.velocity[ours]):
        # Place of the point at the time of the boxes.
        way = velocity * (sweep.time_s + sweep.time_offset - frame.time_s)[:, None]
        then = points - np.column_stack([way, np.zeros(len(sweep))])
        inside |= vehicles[index : index + 1].contains(then, _MARGIN_M)[0]
    return corrupt(sweep, settings, rng, inside)


def _on_vehicles(sweep: Sweep) -> NDArray[np.bool_]:
    of_person = np.zeros(UNKNOWN_MATERIAL + 1, bool)
    of_person[list(_OF_PEOPLE)] = True
    return (sweep.object_id >= 0) & ~of_person[sweep.material]


def _brightness(sweep: Sweep) -> NDArray[np.float64]:
    """Return (P,) returned light, relative to a white surface at normal incidence."""
    reach = sweep.range.astype(np.float64)
    return target_power(sweep, reach) * reach**2
