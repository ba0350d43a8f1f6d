"""Types of road users: SUMO class, label, size and driving limits of each."""

from dataclasses import dataclass

from sim.boxes import CLASSES


@dataclass(frozen=True, slots=True)
class VehicleType:
    """SUMO vType with its label.

    Attributes:
        name: id of the vType.
        label: class name, one of `sim.boxes.CLASSES`.
        vclass: SUMO's vehicle class, which decides on the lanes it may use.
        size: length, width, height of the box, m.
        weight: share within its label.
        speed_mps: top speed, m/s.
        accel_mps2: (strongest acceleration, comfortable deceleration, emergency deceleration).
    """

    name: str
    label: str
    vclass: str
    size: tuple[float, float, float]
    weight: float
    speed_mps: float
    accel_mps2: tuple[float, float, float]

    @property
    def label_index(self) -> int:
        """Index into `sim.boxes.CLASSES`."""
        return CLASSES.index(self.label)

    def xml(self) -> str:
        """Return the vType element of a SUMO route file.

        Pedestrians keep SUMO's own size: the space they take on a pavement is not the box around swinging limbs. Others
        move sideways at no more than 0.15 of their speed: SUMO would let standing cars slide.
        """
        if self.label == "pedestrian":
            return f'<vType id="{self.name}" vClass="pedestrian" maxSpeed="{self.speed_mps}" speedDev="0.1"/>'
        length, width, height = self.size
        accel, decel, emergency = self.accel_mps2
        deviation = 0.05 if self.label in ("truck", "bus") else 0.1
        return (
            f'<vType id="{self.name}" vClass="{self.vclass}" length="{length}" width="{width}" height="{height}" '
            f'maxSpeed="{self.speed_mps}" accel="{accel}" decel="{decel}" emergencyDecel="{emergency}" '
            f'speedDev="{deviation}" minGapLat="0.5" latAlignment="center" '
            'maxSpeedLat="0.8" lcMaxSpeedLatStanding="0" lcMaxSpeedLatFactor="0.15"/>'
        )


_CAR, _VAN, _HEAVY = (2.6, 4.5, 8.0), (2.2, 4.2, 7.5), (1.2, 3.5, 6.5)

TYPES: dict[str, VehicleType] = {
    row[0]: VehicleType(*row)
    for row in (
        ("car_micro", "car", "passenger", (3.60, 1.62, 1.50), 0.08, 40.0, _CAR),
        ("car_small", "car", "passenger", (4.00, 1.74, 1.46), 0.18, 45.0, _CAR),
        ("car_compact", "car", "passenger", (4.28, 1.79, 1.46), 0.24, 50.0, _CAR),
        ("car_coupe", "car", "passenger", (4.42, 1.82, 1.34), 0.06, 60.0, (3.2, 4.5, 8.5)),
        ("car_saloon", "car", "passenger", (4.70, 1.84, 1.45), 0.16, 55.0, _CAR),
        ("car_estate", "car", "passenger", (4.78, 1.85, 1.50), 0.12, 55.0, _CAR),
        ("car_suv", "car", "passenger", (4.65, 1.90, 1.68), 0.12, 50.0, _CAR),
        ("car_large", "car", "passenger", (5.10, 1.92, 1.48), 0.04, 60.0, _CAR),
        ("van_small", "van", "delivery", (4.50, 1.83, 1.85), 0.40, 42.0, _VAN),
        ("van_people", "van", "passenger", (5.15, 1.95, 1.95), 0.25, 45.0, _VAN),
        ("van_box", "van", "delivery", (5.95, 2.05, 2.60), 0.35, 40.0, _VAN),
        ("truck_light", "truck", "truck", (7.00, 2.35, 2.90), 0.40, 27.0, _HEAVY),
        ("truck_box", "truck", "truck", (8.60, 2.50, 3.55), 0.35, 25.0, _HEAVY),
        ("truck_heavy", "truck", "truck", (10.20, 2.55, 3.80), 0.25, 25.0, _HEAVY),
        ("bus_midi", "bus", "bus", (9.60, 2.45, 3.00), 0.30, 24.0, _HEAVY),
        ("bus_city", "bus", "bus", (12.00, 2.55, 3.15), 0.70, 24.0, _HEAVY),
        ("motorcycle_scooter", "motorcycle", "motorcycle", (1.90, 0.75, 1.62), 0.5, 25.0, (3.5, 5.0, 8.0)),
        ("motorcycle_road", "motorcycle", "motorcycle", (2.20, 0.85, 1.65), 0.5, 55.0, (5.0, 6.0, 9.0)),
        ("bicycle_city", "bicycle", "bicycle", (1.75, 0.65, 1.75), 0.6, 5.2, (1.2, 3.0, 6.0)),
        ("bicycle_fast", "bicycle", "bicycle", (1.70, 0.55, 1.65), 0.4, 7.0, (1.4, 3.0, 6.0)),
        ("person_tall", "pedestrian", "pedestrian", (0.60, 0.60, 1.86), 0.3, 1.5, (1.5, 2.0, 5.0)),
        ("person_middle", "pedestrian", "pedestrian", (0.60, 0.58, 1.72), 0.5, 1.4, (1.5, 2.0, 5.0)),
        ("person_child", "pedestrian", "pedestrian", (0.45, 0.45, 1.25), 0.2, 1.2, (1.5, 2.0, 5.0)),
    )
}
"""Vehicle types by name."""


def types_of(label: str) -> list[VehicleType]:
    """Return the types of one label, in the order of the table."""
    return [kind for kind in TYPES.values() if kind.label == label]
