"""Types of road users in worlds of version 2: sizes as distributions, a body shape and the looks of each.

Means and spreads are set so that each class agrees with the boxes that data sets publish (length, width, height, m):

* KITTI, mean: car 3.88 1.63 1.53 (sd 0.43 0.10 0.14), van 5.07 1.90 2.21, lorry 10.14 2.59 3.25, pedestrian 0.84 0.66
  1.76 (sd 0.22 0.15 0.09), cyclist 1.76 0.60 1.74 (Qi et al., Frustum PointNets, CVPR 2018, in its code);
* nuScenes, mean: car 4.63 1.97 1.74, lorry 6.93 2.51 2.84 with pick-ups, bus 10.5 2.94 3.47, motorcycle 2.11 0.77 1.47,
  bicycle 1.70 0.60 1.28 with those without a rider, pedestrian 0.73 0.67 1.77 (Zhu et al., CBGS, arXiv 1908.09492);
* Waymo, mean: vehicle 4.73 2.08 1.77, pedestrian 0.91 0.84 1.74, cyclist 1.81 0.84 1.77 (MMDetection3D's anchors);
* Lyft Level 5, mean: car 4.75 1.92 1.71, lorry 10.24 2.84 3.44, bus 12.70 2.92 3.42 (MMDetection3D's anchors).

Cars follow the stock of Germany: of 49.1 million on 1 January 2024 23.2 % were compact, 18.6 % SUV, 17.7 % small
(Kraftfahrt-Bundesamt); the other shares are estimates. Lengths and widths of lorries and buses keep to Directive
96/53/EC, mirrors excepted.
"""

from dataclasses import dataclass

from sim.bodies.vehicle_types import VehicleType

Size = tuple[float, float, float]

REACH = 2.2
"""Largest deviation of a size from its mean, in spreads."""


@dataclass(frozen=True, slots=True)
class VariedType:
    """Type of road users with a distribution of sizes.

    Attributes:
        kind: name, class, share within the class and driving limits; its size is the mean, m.
        spread: standard deviations of length, width and height, m, each cut at `REACH`.
        shape: shape of `sim.bodies.varied.shapes`.
        variants: (variant of the shape, weight).
        looks: `paint` of cars, `fleet` of vans and lorries, `livery` of buses, `clothes`.
    """

    kind: VehicleType
    spread: Size
    shape: str
    variants: tuple[tuple[str, float], ...]
    looks: str

    @property
    def largest(self) -> Size:
        """Largest length, width and height, m."""
        length, width, height = (m + REACH * s for m, s in zip(self.kind.size, self.spread, strict=True))
        return length, width, height


_CAR, _VAN, _HEAVY = (2.6, 4.5, 8.0), (2.2, 4.2, 7.5), (1.2, 3.5, 6.5)
_TWO, _CYCLE, _FOOT = (4.0, 5.5, 8.5), (1.2, 3.0, 6.0), (1.5, 2.0, 5.0)
# Rear panes are tinted dark in part of the cars, and some windscreens carry a film of metal against heat.
_PANES = (("clear", 0.55), ("privacy", 0.30), ("coated", 0.15))
_PLAIN = (("plain", 1.0),)

_ROWS = (
    # name, shape, mean size, spread, share, top speed
    ("car", "passenger", _CAR, "paint", _PANES, (
        ("car_city", "city_car", (3.60, 1.74, 1.50), (0.13, 0.04, 0.04), 0.08, 40.0),
        ("car_small", "hatchback", (4.02, 1.85, 1.46), (0.11, 0.04, 0.04), 0.18, 45.0),
        ("car_compact", "hatchback", (4.32, 1.92, 1.47), (0.11, 0.04, 0.03), 0.16, 50.0),
        ("car_saloon", "saloon", (4.68, 1.95, 1.45), (0.18, 0.04, 0.03), 0.12, 55.0),
        ("car_estate", "estate", (4.70, 1.95, 1.49), (0.16, 0.04, 0.03), 0.12, 55.0),
        ("car_coupe", "coupe", (4.42, 1.94, 1.34), (0.17, 0.05, 0.05), 0.03, 60.0),
        ("car_small_suv", "small_suv", (4.22, 1.92, 1.60), (0.10, 0.04, 0.05), 0.10, 48.0),
        ("car_suv", "suv", (4.62, 2.01, 1.69), (0.15, 0.05, 0.05), 0.09, 50.0),
        ("car_off_road", "off_road", (4.80, 2.06, 1.86), (0.18, 0.05, 0.06), 0.03, 45.0),
        ("car_people", "people_carrier", (4.48, 1.95, 1.66), (0.18, 0.05, 0.06), 0.07, 48.0),
        ("car_pick_up", "pick_up", (5.28, 2.05, 1.81), (0.14, 0.04, 0.05), 0.02, 45.0),
    )),
    ("van", "passenger", _VAN, "fleet", _PANES, (
        ("van_family", "family_van", (4.48, 1.97, 1.82), (0.14, 0.04, 0.04), 0.14, 44.0),
        ("van_people", "minibus", (5.12, 2.10, 1.96), (0.18, 0.04, 0.05), 0.20, 45.0),
    )),
    ("van", "delivery", _VAN, "fleet", _PLAIN, (
        ("van_small", "small_van", (4.44, 1.97, 1.84), (0.14, 0.04, 0.04), 0.26, 42.0),
        ("van_panel", "panel_van", (5.18, 2.11, 2.00), (0.17, 0.04, 0.08), 0.20, 42.0),
        ("van_large", "large_van", (6.10, 2.25, 2.64), (0.40, 0.05, 0.12), 0.20, 40.0),
    )),
    ("truck", "truck", _HEAVY, "fleet", _PLAIN, (
        ("truck_light", "light_lorry", (7.00, 2.36, 3.00), (0.55, 0.07, 0.20), 0.28, 27.0),
        ("truck_box", "box_lorry", (9.50, 2.55, 3.75), (0.70, 0.03, 0.12), 0.22, 25.0),
        ("truck_tipper", "tipper", (8.10, 2.54, 3.05), (0.45, 0.03, 0.10), 0.08, 25.0),
        ("truck_flatbed", "flatbed", (7.60, 2.51, 2.88), (0.60, 0.04, 0.12), 0.07, 25.0),
        ("truck_tanker", "tanker", (9.40, 2.55, 3.20), (0.45, 0.03, 0.10), 0.05, 25.0),
    )),
    ("truck", "truck", _HEAVY, "fleet", (("plain", 0.7), ("blue", 0.3)), (
        ("truck_semi_trailer", "semi_trailer", (16.30, 2.57, 3.96), (0.09, 0.02, 0.05), 0.30, 25.0),
    )),
    ("bus", "bus", _HEAVY, "livery", (("clear", 0.7), ("coated", 0.3)), (
        ("bus_midi", "midi_bus", (9.60, 2.58, 3.10), (0.50, 0.05, 0.08), 0.20, 24.0),
        ("bus_city", "city_bus", (12.00, 2.75, 3.20), (0.10, 0.04, 0.06), 0.60, 24.0),
        ("bus_coach", "coach", (12.60, 2.76, 3.75), (0.50, 0.04, 0.08), 0.20, 28.0),
    )),
    ("motorcycle", "motorcycle", _TWO, "rider", _PLAIN, (
        ("motorcycle_road", "road_motorcycle", (2.10, 0.88, 1.64), (0.06, 0.04, 0.05), 0.32, 55.0),
        ("motorcycle_tourer", "tourer", (2.20, 0.92, 1.66), (0.07, 0.04, 0.05), 0.14, 55.0),
    )),
    ("motorcycle", "motorcycle", _TWO, "rider", (("plain", 0.68), ("box", 0.18), ("pillion", 0.14)), (
        ("motorcycle_scooter", "scooter", (1.87, 0.80, 1.68), (0.07, 0.04, 0.05), 0.54, 25.0),
    )),
    ("bicycle", "bicycle", _CYCLE, "clothes", (("plain", 0.58), ("panniers", 0.20), ("box", 0.10), ("child", 0.12)), (
        ("bicycle_city", "city_bike", (1.78, 0.70, 1.76), (0.05, 0.05, 0.08), 0.65, 5.2),
    )),
    ("bicycle", "bicycle", _CYCLE, "clothes", _PLAIN, (
        ("bicycle_fast", "racing_bike", (1.69, 0.58, 1.52), (0.04, 0.04, 0.07), 0.25, 7.0),
    )),
    ("bicycle", "bicycle", _CYCLE, "clothes", (("plain", 0.5), ("cover", 0.5)), (
        ("bicycle_cargo", "cargo_bike", (2.66, 0.76, 1.76), (0.10, 0.05, 0.08), 0.10, 5.0),
    )),
    ("pedestrian", "pedestrian", _FOOT, "clothes", (("plain", 0.8), ("bag", 0.2)), (
        ("person_standing", "standing", (0.38, 0.60, 1.74), (0.03, 0.04, 0.09), 0.06, 1.2),
        ("person_strolling", "strolling", (0.58, 0.60, 1.73), (0.04, 0.04, 0.09), 0.18, 1.2),
        ("person_passing", "passing", (0.38, 0.60, 1.74), (0.04, 0.04, 0.09), 0.10, 1.4),
    )),
    ("pedestrian", "pedestrian", _FOOT, "clothes", (("plain", 0.6), ("backpack", 0.25), ("bag", 0.15)), (
        ("person_walking", "walking", (0.80, 0.60, 1.74), (0.05, 0.04, 0.09), 0.40, 1.4),
    )),
    ("pedestrian", "pedestrian", _FOOT, "clothes", _PLAIN, (
        ("person_running", "running", (0.89, 0.60, 1.70), (0.05, 0.04, 0.08), 0.04, 2.6),
        ("person_child", "walking", (0.58, 0.44, 1.25), (0.06, 0.04, 0.14), 0.09, 1.2),
    )),
    ("pedestrian", "pedestrian", _FOOT, "clothes", (("suitcase", 1.0),), (
        ("person_suitcase", "walking", (1.12, 0.66, 1.74), (0.05, 0.04, 0.09), 0.04, 1.2),
    )),
    ("pedestrian", "pedestrian", _FOOT, "clothes", (("umbrella", 1.0),), (
        ("person_umbrella", "strolling", (0.95, 1.00, 2.04), (0.04, 0.05, 0.09), 0.03, 1.2),
    )),
    ("pedestrian", "pedestrian", _FOOT, "clothes", (("pram", 1.0),), (
        ("person_pram", "strolling", (1.58, 0.60, 1.72), (0.05, 0.03, 0.08), 0.06, 1.2),
    )),
)  # fmt: skip

VARIED: dict[str, VariedType] = {
    name: VariedType(VehicleType(name, label, vclass, mean, share, speed, accel), spread, shape, variants, looks)
    for label, vclass, accel, looks, variants, rows in _ROWS
    for name, shape, mean, spread, share, speed in rows
}
"""Types by name; those of one class share its weight."""
