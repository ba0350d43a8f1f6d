"""Mix of road users of an imported map, as a text: how many of each class for how many of the others."""

from collections.abc import Mapping

import msgspec

from sim.boxes import CLASSES
from sim.errors import SettingsError, complaint, did_you_mean
from sim.scenario import MOTOR_CLASSES, DemandSpec

_MOST = 100.0


def read_mix(text: str) -> dict[str, float]:
    """Return the weights of a text such as `car=3,motorcycle=6,bicycle=1`; empty of an empty one.

    Raises:
        SettingsError: an unknown class, a weight that is no number from 0 to 100, a class twice, or no weight of cars,
            of which the connected vehicles are taken.
    """
    mix: dict[str, float] = {}
    for part in text.split(",") if text.strip() else []:
        label, _, weight = (word.strip() for word in part.partition("="))
        if label not in CLASSES or label in mix:
            expected = f"each of {', '.join(CLASSES)} at most once"
            raise SettingsError(complaint("scenario import", "mix", expected, label, did_you_mean(label, CLASSES)))
        try:
            mix[label] = float(weight)
        except ValueError:
            mix[label] = -1.0
        if not 0.0 <= mix[label] <= _MOST:
            expected = f"{label}=WEIGHT, a number from 0 to {_MOST:g}"
            raise SettingsError(complaint("scenario import", "mix", expected, part.strip()))
    if mix and not mix.get("car"):
        raise SettingsError(complaint("scenario import", "mix", "a weight of car above 0", text))
    return mix


def with_mix(demand: DemandSpec, mix: Mapping[str, float]) -> DemandSpec:
    """Return a demand in which a mix replaces the weights of motor vehicles, of classes that have routes.

    Bicycles and pedestrians that the mix names come at their weight over that of all motor vehicles, times the rate of
    these; others keep their rate. Where the demand has none, since the map has no way for them, none are added.
    """
    motor = {label: mix[label] for label in MOTOR_CLASSES if mix.get(label) and label in demand.type_mix}
    if not motor:
        return demand

    def rate(label: str, now: float) -> float:
        if label not in mix or now == 0.0:
            return now
        return round(mix[label] / sum(motor.values()) * demand.vehicles_per_hour, 1)

    return msgspec.structs.replace(
        demand,
        type_mix=motor,
        bicycles_per_hour=rate("bicycle", demand.bicycles_per_hour),
        persons_per_hour=rate("pedestrian", demand.persons_per_hour),
    )
