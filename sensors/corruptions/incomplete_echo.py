"""Incomplete echo: dark, glossy vehicles send too little light back, and their points are missing.

| severity                                   | 1  | 2  | 3  | 4  | 5  |
|--------------------------------------------|----|----|----|----|----|
| share of the points on vehicles lost, %    | 25 | 50 | 75 | 85 | 95 |

Of the n points on vehicles `int(share n)` are lost, those first whose surface sends the least light back: dark paint
before light paint, panels seen at a grazing angle before those seen squarely, plates and reflectors last; so dark cars
are gone when light ones still have half their points. How much light that is, the intensity says, or the material and
the angle of incidence where it does not (`receiver.target_power`); speckle, a gamma law of 4 independent cells, blurs
the order, and alone decides where nothing is known. What is lost at a severity is lost at the next.

The shares of levels 3 to 5 are Robo3D's light, moderate and heavy; there points are lost at random. Which points are on
vehicles, ids and materials say; a frame knows the classes of its objects and, for files without ids, their boxes
(`in_frame`). Bicycles and motorcycles count, people do not. Nothing else is touched.
"""

from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import at_level, check_range
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


class IncompleteEcho(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        share: of the points on vehicles that are lost.
    """

    share: float = 0.75

    def __post_init__(self) -> None:
        check_range("IncompleteEcho", "share", self.share, 0.0, 1.0)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(share=at_level(SHARE, level))


def corrupt(
    sweep: Sweep,
    severity: int | IncompleteEcho,
    rng: np.random.Generator,
    on_vehicle: NDArray[np.bool_] | None = None,
) -> Sweep:
    """Remove the faintest points on vehicles; the others stay as they are, in order.

    Args:
        sweep: any sweep.
        severity: 1 to 5, or the settings.
        rng: draws the speckle.
        on_vehicle: (P,) which points are on vehicles; left out, objects that are not made of a person's materials.
    """
    settings = severity if isinstance(severity, IncompleteEcho) else IncompleteEcho.severity(severity)
    on = np.flatnonzero(_on_vehicles(sweep) if on_vehicle is None else on_vehicle)
    speckle = rng.gamma(_SPECKLE_CELLS, 1.0, len(on))
    lost = int(settings.share * len(on))
    if lost == 0:
        return sweep
    brightness = np.maximum(_brightness(sweep[on]), _LEAST_BRIGHTNESS) * speckle
    kept = np.ones(len(sweep), bool)
    kept[on[np.argsort(brightness, kind="stable")[:lost]]] = False
    return sweep[kept]


def in_frame(frame: Frame, row: int, severity: int | IncompleteEcho, rng: np.random.Generator) -> Sweep:
    """Return the sweep of the agent in a row of `frame.agents`, whose vehicles the frame knows."""
    sweep = frame.agents[row].sweep
    ours = frame.truth.label != CLASSES.index("pedestrian")
    vehicles = frame.truth[ours]
    if (sweep.object_id >= 0).any():
        return corrupt(sweep, severity, rng, np.isin(sweep.object_id, vehicles.object_id))
    points, inside = sweep.world_points, np.zeros(len(sweep), bool)
    for index, velocity in enumerate(frame.velocity[ours]):
        # Where the point would lie had the beam fired at the time of the boxes.
        way = velocity * (sweep.time_s + sweep.time_offset - frame.time_s)[:, None]
        then = points - np.column_stack([way, np.zeros(len(sweep))])
        inside |= vehicles[index : index + 1].contains(then, _MARGIN_M)[0]
    return corrupt(sweep, severity, rng, inside)


def _on_vehicles(sweep: Sweep) -> NDArray[np.bool_]:
    of_person = np.zeros(UNKNOWN_MATERIAL + 1, bool)
    of_person[list(_OF_PEOPLE)] = True
    return (sweep.object_id >= 0) & ~of_person[sweep.material]


def _brightness(sweep: Sweep) -> NDArray[np.float64]:
    """Return (P,) the light that the points' surfaces send back, relative to a white one seen squarely."""
    reach = sweep.range.astype(np.float64)
    return target_power(sweep, reach) * reach**2
