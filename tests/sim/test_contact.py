"""First contact: nothing is jumped over, and its instant, speeds, side and fault are those computed by hand."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import trimesh

from sim.boxes import CLASSES, Boxes
from sim.contact import MASS_KG, Contact, SolidWorld, first_contact, world_contact
from sim.mesh.materials import material_index
from sim.mesh.solids import box, to_mesh
from sim.traffic.base import Actors

EGO = 1000
CAR = (4.0, 2.0, 1.5)


def actors(time_s: float, *rows: tuple) -> Actors:
    """Actors of (x, y, yaw) or (x, y, yaw, size, class, z), the ego first."""
    table = [(*row, *(CAR, "car", 0.75)[len(row) - 3 :]) for row in rows]
    n = len(table)
    boxes = Boxes.from_array(
        [(x, y, z, *size, yaw) for x, y, yaw, size, _, z in table],
        label=[CLASSES.index(row[4]) for row in table],
        object_id=EGO + np.arange(n),
    )
    zero = np.zeros((n, 2))
    names = tuple("ego" if k == 0 else f"other{k}" for k in range(n))
    return Actors(time_s, boxes, np.zeros(n), zero, zero, ("",) * n, names, np.zeros(n, np.int32), ("",) * n)


def met(before: list[tuple], now: list[tuple]) -> Contact | None:
    return first_contact(actors(1.0, *before), actors(1.1, *now), EGO)


def test_an_ego_that_drives_into_a_standing_car() -> None:
    """15 m/s; 0.6 m between the bumpers are gone after 0.04 s; equal masses share the speed."""
    found = met([(0, 0, 0), (4.6, 0, 0)], [(1.5, 0, 0), (4.6, 0, 0)])
    assert found is not None
    assert (found.other_id, found.other, found.side, found.at_fault) == (EGO + 1, "other1", "front", True)
    assert found.time_s == pytest.approx(1.04, abs=2e-4)
    assert found.ego_speed_mps == pytest.approx(15.0) and found.closing_mps == pytest.approx(15.0)
    assert found.delta_v_mps == pytest.approx(7.5)


def test_a_standing_ego_that_is_hit_from_behind() -> None:
    """A lorry of 12 t at 10 m/s gives a car of 1.5 t eight ninths of its speed."""
    lorry = ((10.0, 2.5, 3.8), "truck", 1.9)
    found = met([(0, 0, 0), (-7.5, 0, 0, *lorry)], [(0, 0, 0), (-6.5, 0, 0, *lorry)])
    assert found is not None
    assert (found.side, found.at_fault) == ("rear", False)
    assert found.time_s == pytest.approx(1.05, abs=2e-4)
    assert found.closing_mps == pytest.approx(10.0)
    assert found.delta_v_mps == pytest.approx(10.0 * MASS_KG["truck"] / (MASS_KG["truck"] + MASS_KG["car"]))


def test_a_moving_ego_that_is_hit_from_behind_is_not_at_fault_and_a_standing_one_never() -> None:
    assert met([(0, 0, 0), (-4.5, 0, 0)], [(0.5, 0, 0), (-3.0, 0, 0)]).at_fault is False
    assert met([(0, 0, 0), (0, 3.5, -1.57)], [(0, 0, 0), (0, 2.0, -1.57)]).at_fault is False
    assert met([(0, 0, 0), (-5.0, 0, 0)], [(-1.5, 0, 0), (-5.0, 0, 0)]).at_fault is True  # it drives backwards


@pytest.mark.parametrize(("y", "yaw", "side"), [(3.6, -np.pi / 2, "left"), (-3.6, np.pi / 2, "right")])
def test_a_crossing_car_hits_the_ego_at_its_side(y: float, yaw: float, side: str) -> None:
    found = met([(-0.5, 0, 0), (0, y, yaw)], [(0.5, 0, 0), (0, 0.5 * y, yaw)])
    assert found is not None and found.side == side and found.at_fault
    # Half the length of one and half the width of the other touch when the centres are 3 m apart.
    assert found.time_s == pytest.approx(1.0 + 0.1 * 0.6 / 1.8, abs=2e-4)
    assert found.closing_mps == pytest.approx(18.0)


def test_the_ego_hits_the_flank_of_a_crossing_car_with_its_front() -> None:
    """Along the normal only the ego moves: the crossing speed does not count."""
    found = met([(0, 0, 0), (3.5, -0.6, np.pi / 2)], [(1.0, 0, 0), (3.5, 0.6, np.pi / 2)])
    assert found is not None and found.side == "front" and found.at_fault
    assert found.closing_mps == pytest.approx(10.0) and found.delta_v_mps == pytest.approx(5.0)


@pytest.mark.parametrize("at", [-1.9, -0.3, 0.0, 1.2])
def test_nothing_is_jumped_over(at: float) -> None:
    """Half a metre crosses a bonnet at 40 m/s: before and after the step it is beside the car."""
    child = ((0.5, 0.5, 1.2), "pedestrian", 0.6)
    found = met([(0, 0, 0), (at, -2.0, 0, *child)], [(0, 0, 0), (at, 2.0, 0, *child)])
    assert found is not None and found.side == "right"
    assert found.time_s == pytest.approx(1.0 + 0.1 * 0.75 / 4.0, abs=2e-4)
    assert found.delta_v_mps == pytest.approx(40.0 * 75.0 / 1575.0)
    assert met([(0, 0, 0), (2.3, -2.0, 0, *child)], [(0, 0, 0), (2.3, 2.0, 0, *child)]) is None


def test_the_first_of_two_contacts_counts() -> None:
    near, far = (4.6, 1.2, 0), (4.9, -1.2, 0)
    found = met([(0, 0, 0), far, near], [(1.5, 0, 0), far, near])
    assert found is not None and found.other == "other2"


def test_a_turning_box_sweeps_what_lies_beside_its_ends() -> None:
    bus = ((12.0, 2.5, 3.0), "bus", 1.5)
    post = (5.0, 1.9, 0, (0.4, 0.4, 1.5))
    assert met([(0, 0, 0, *bus), (*post, "pedestrian", 0.75)], [(0, 0, 0, *bus), (*post, "pedestrian", 0.75)]) is None
    found = met([(0, 0, 0, *bus), (*post, "pedestrian", 0.75)], [(0, 0, 0.3, *bus), (*post, "pedestrian", 0.75)])
    assert found is not None and found.side == "left"


def test_passing_beside_and_above_is_no_contact() -> None:
    assert met([(0, 0, 0), (20, 2.05, np.pi)], [(2, 0, 0), (16, 2.05, np.pi)]) is None
    assert (
        met([(-3, 0, 0), (0, 0, np.pi / 2, CAR, "car", 6.0)], [(3, 0, 0), (0, 0, np.pi / 2, CAR, "car", 6.0)]) is None
    )


@pytest.mark.parametrize("turned", [0.4, 1.9, -2.6])
def test_the_world_may_be_turned(turned: float) -> None:
    def rotated(rows: list[tuple]) -> list[tuple]:
        c, s = np.cos(turned), np.sin(turned)
        return [(c * x - s * y + 30.0, s * x + c * y - 7.0, yaw + turned) for x, y, yaw in rows]

    before, now = [(0, 0, 0), (4.5, 0.6, 2.4)], [(1.2, 0, 0.02), (4.1, 0.5, 2.3)]
    plain, other = met(before, now), met(rotated(before), rotated(now))
    assert plain is not None and other is not None
    assert other == replace(
        plain,
        time_s=pytest.approx(plain.time_s),
        ego_speed_mps=pytest.approx(plain.ego_speed_mps),
        closing_mps=pytest.approx(plain.closing_mps),
        delta_v_mps=pytest.approx(plain.delta_v_mps),
    )


def world(*parts: tuple) -> SolidWorld:
    """Blocks of (low corner, high corner, material)."""
    meshes = []
    for low, high, material in parts:
        part = trimesh.creation.box(bounds=[low, high])
        part.face_attributes["material"] = np.full(len(part.faces), material_index(material), np.uint8)
        meshes.append(part)
    faces = np.concatenate([m.faces + 8 * k for k, m in enumerate(meshes)])
    material = np.concatenate([m.face_attributes["material"] for m in meshes])
    vertices = np.concatenate([m.vertices for m in meshes])
    return SolidWorld.of(trimesh.Trimesh(vertices, faces, face_attributes={"material": material}, process=False))


def test_a_wall_a_pole_and_a_tunnel() -> None:
    wall = world(((3.0, -20.0, 0.0), (4.0, 20.0, 9.0), "brick"))
    found = world_contact(actors(1.0, (0, 0, 0)), actors(1.1, (1.5, 0, 0)), EGO, wall)
    assert found is not None
    assert (found.other_id, found.other, found.side, found.at_fault) == (-1, "world", "front", True)
    assert found.time_s == pytest.approx(1.0 + 0.1 / 1.5, abs=1e-3)
    assert found.closing_mps == pytest.approx(15.0) and found.delta_v_mps == pytest.approx(15.0)
    pole = world(((2.5, 0.3, 0.0), (2.6, 0.4, 6.0), "metal"))
    assert world_contact(actors(1.0, (0, 0, 0)), actors(1.1, (4.5, 0, 0)), EGO, pole) is not None
    bridge = world(((3.0, -20.0, 4.5), (9.0, 20.0, 5.5), "concrete"), ((0.0, -5.0, -0.1), (9.0, 5.0, 0.0), "asphalt"))
    assert world_contact(actors(1.0, (0, 0, 0)), actors(1.1, (4.5, 0, 0)), EGO, bridge) is None


def test_a_car_that_keeps_its_lane_touches_nothing_of_a_shipped_world() -> None:
    from sim.encounters import with_encounter
    from sim.traffic.script import ScriptedTraffic
    from sim.world.build import build_world
    from tests.sim.encounters.test_encounters import encounter

    scenario = with_encounter(encounter("ima_building", control="no_conflict"), 1)
    solid = SolidWorld.of(build_world(scenario, 1))
    assert len(solid.low_m) > 100
    with ScriptedTraffic(scenario, 1) as traffic:
        while traffic.time_s < 10.0:
            before = traffic.actors
            now = traffic.step()
            assert world_contact(before, now, EGO, solid) is None
    aside = replace(now, boxes=replace(now.boxes, center=now.boxes.center + np.array([0.0, 30.0, 0.0])))
    house = shapely.box(*np.concatenate([aside.boxes.center[0, :2] - 40.0, aside.boxes.center[0, :2] + 40.0]))
    assert len(solid.tree.query(house)) > 0


def test_boxes_of_solids_are_solid() -> None:
    crate = to_mesh(box((3.0, 0.0, 1.0), (1.0, 1.0, 2.0), "concrete"))
    assert world_contact(actors(1.0, (0, 0, 0)), actors(1.1, (1.0, 0, 0)), EGO, SolidWorld.of(crate)) is not None


def test_a_corner_that_touches_belongs_to_the_side_that_the_bodies_approach_through() -> None:
    wall = (2.8, 1.8, -np.pi / 4, (6.0, 1.0, 1.5), "bus", 0.75)
    ahead = met([(0, 0, 0), wall], [(1.5, 0, 0), wall])
    aside = met([(0, 0, 0), wall], [(0, 1.5, 0), wall])
    assert ahead is not None and ahead.side == "front"
    assert aside is not None and aside.side == "left"
    assert ahead.closing_mps == pytest.approx(15.0 / np.sqrt(2.0), rel=1e-3)
