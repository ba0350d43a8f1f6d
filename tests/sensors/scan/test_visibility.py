"""The visible fraction says what hides an object, and nothing else changes it."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from sensors.frame import count_points
from sensors.motion import Path
from sensors.recording.record import record
from sensors.scan.lidar import Sensor, scan_all
from sensors.scan.scene import RayScene
from sensors.scan.visibility import visible_fraction
from sensors.spec import LidarSpec
from sim.geometry import pose_matrix
from tests.sensors.fakes import (
    StraightTraffic,
    box,
    box_body,
    cars,
    ground,
    ideal,
    scene_of,
    toy_scenario,
)

HEIGHT_M = 1.8
FINE = LidarSpec(
    name="fine",
    elevation_deg=tuple(np.linspace(8.0, -24.0, 128)),
    columns=2880,
    source="a test's",
    range_noise_m=0.0,
    dropoff_rate=0.0,
    range_max_m=100.0,
)


def sensor_at(
    x: float = 0.0,
    y: float = 0.0,
    *,
    spec: LidarSpec = FINE,
    yaw: float = 0.0,
    speed: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
    rides_on: int | None = None,
) -> Sensor:
    moved = np.array([[-0.05, 0, 0], [0.05, 0, 0]])[:, :1] * np.array([*speed, 0.0])
    poses = pose_matrix(np.array([x, y, HEIGHT_M]) + moved, np.full(2, yaw))
    return Sensor(spec, Path.through(np.array([-0.05, 0.05]), poses), 0.0, np.random.default_rng(seed), rides_on)


def fractions(scene: RayScene, sensor: Sensor | None = None) -> np.ndarray:
    return visible_fraction(scene, [sensor or sensor_at()], scene.bodies.object_id)[0]


@pytest.mark.parametrize("spec", [FINE, ideal("debug-16"), ideal("livox-avia")])
@pytest.mark.parametrize("world", [None, ground()])
def test_an_object_alone_is_seen_wholly(world: trimesh.Trimesh | None, spec: LidarSpec) -> None:
    scene = scene_of(world, cars([[12.0, 1.0, 0.4]], speed=12.0))
    assert fractions(scene, sensor_at(spec=spec)).tolist() == [1.0]


def test_an_object_behind_a_wall_is_not_seen() -> None:
    scene = scene_of(box((0.2, 40.0, 10.0), (8.0, 0.0, 5.0)), cars([[12.0, 0, 0], [-12.0, 0, 0]]))
    assert fractions(scene).tolist() == [0.0, 1.0]


def test_half_a_wall_hides_half_of_a_panel() -> None:
    """A panel across the view from y = -4 to 4 at 20 m; a wall half as far hides what lies left of y = 0.

    Seen from the origin, y = 0 halves the columns on the panel.
    """
    panel = cars([[20.0, 0.0, np.pi / 2]], size=(8.0, 0.01, 3.0))
    halved = scene_of(box((0.01, 8.0, 20.0), (10.0, 4.0, 0.0)), panel)
    assert fractions(halved)[0] == pytest.approx(0.5, abs=0.01)
    # Below the edge of a wall as high as the line from the sensor to the panel's middle, half of the height is seen:
    # the line at 1.8 m is level, so a wall that hangs from there hides the upper 1.2 m of 3 m.
    hanging = scene_of(box((0.01, 30.0, 20.0), (10.0, 0.0, HEIGHT_M + 10.0)), panel)
    assert fractions(hanging)[0] == pytest.approx(1.8 / 3.0, abs=0.03)


def test_the_part_that_another_body_hides_is_the_angle_that_it_covers() -> None:
    """A panel 8 m wide at 20 m behind a box 1 m wide, whose front is at 10 m and which is taller than the view."""
    panel, pole = cars([[20.0, 0.0, np.pi / 2]], size=(8.0, 0.01, 3.0)), cars([[10.005, 0.0, 0]], size=(0.01, 1.0, 9.0))
    both = replace(
        panel,
        boxes=type(panel.boxes).from_array(
            np.concatenate([panel.boxes.array, pole.boxes.array]), object_id=np.array([1000, 1001])
        ),
        **{
            name: np.concatenate([getattr(panel, name)] * 2)
            for name in ("pitch", "roll", "velocity", "acceleration", "signals")
        },
        **{name: getattr(panel, name) * 2 for name in ("model", "name", "lane")},
    )
    seen = fractions(scene_of(None, both))
    covered = np.arctan(0.5 / 10.0) / np.arctan(4.0 / 20.0)
    assert seen[1] == 1.0
    assert seen[0] == pytest.approx(1.0 - covered, abs=0.01)


SLANTED = msgspec.structs.replace(
    FINE, azimuth_offset_deg=tuple(np.tile([-6.0, 2.0, 5.0, -1.0], 32)), firing_s=tuple(np.linspace(0.0, 3e-5, 128))
)


@pytest.mark.parametrize("spec", [FINE, SLANTED, msgspec.structs.replace(SLANTED, clockwise=True)])
def test_without_noise_and_loss_it_is_the_share_of_the_points(spec: LidarSpec) -> None:
    rows = [[15, 0.5, 0.3], [9, 1.5, 0], [-14, 4, 2.0], [-9, 2.4, 1.0], [30, -8, 0.9], [21, -6, 0]]
    crowd = cars(rows, speed=[8.0, -5.0, 3.0, 0.0, 20.0, 9.0])
    sensor = sensor_at(spec=spec, speed=(12.0, 1.0))
    together = scan_all(scene_of(ground(), crowd), [sensor])[0]
    seen = count_points(together, crowd.boxes.object_id)
    alone = [
        count_points(scan_all(scene_of(None, one), [sensor])[0], one.boxes.object_id)[0]
        for one in (
            cars([row], speed=speed, first_id=1000 + i)
            for i, (row, speed) in enumerate(zip(rows, [8.0, -5.0, 3.0, 0.0, 20.0, 9.0], strict=True))
        )
    ]
    expected = seen / np.array(alone)
    assert expected.min() < 0.7 < expected.max()  # some are hidden in part
    np.testing.assert_allclose(fractions(scene_of(ground(), crowd), sensor), expected, atol=0.02)


places = st.tuples(st.floats(-25, 25), st.floats(-25, 25), st.floats(-3.1, 3.1)).filter(lambda p: np.hypot(*p[:2]) > 4)


@settings(max_examples=25, deadline=None)
@given(st.lists(places, min_size=1, max_size=6), places, st.tuples(st.floats(-20, 20), st.floats(-20, 20)))
def test_fractions_are_shares_and_another_occluder_never_raises_one(
    rows: list[list[float]], newcomer: list[float], post: tuple[float, float]
) -> None:
    calm = ideal("debug-16", columns=900)

    def of(rows: list[list[float]], static: trimesh.Trimesh) -> np.ndarray:
        return fractions(scene_of(static, cars(rows)), sensor_at(spec=calm))[: len(rows)]

    before = of(rows, None)
    more, walled = of([*rows, newcomer], None)[:-1], of(rows, box((1.0, 1.0, 5.0), (*post, 2.5)))
    for seen in (before, more, walled):
        assert ((seen >= 0) & (seen <= 1) | np.isnan(seen)).all()
    assert (np.isnan(before) == np.isnan(more)).all() and (np.isnan(before) == np.isnan(walled)).all()
    assert (np.nan_to_num(more) <= np.nan_to_num(before)).all()
    assert (np.nan_to_num(walled) <= np.nan_to_num(before)).all()


def test_noise_and_lost_points_change_nothing() -> None:
    crowd = cars([[15, 0.5, 0.3], [9, 1.5, 0], [-14, 4, 2.0]])
    scene, calm = scene_of(ground(), crowd), ideal("opv2v-64")
    wild = ideal("opv2v-64", range_noise_m=0.3, dropoff_rate=0.7, dropoff_zero_intensity=1.0, range_10_m=20.0)
    points = [count_points(scan_all(scene, [sensor_at(spec=s)])[0], crowd.boxes.object_id).sum() for s in (calm, wild)]
    assert points[1] < 0.5 * points[0]
    of_wild = [fractions(scene, sensor_at(spec=wild, seed=seed)) for seed in (1, 2)]
    for seen in of_wild:
        assert np.array_equal(seen, fractions(scene, sensor_at(spec=calm)))


def test_objects_out_of_reach_have_no_fraction() -> None:
    crowd = cars([[12.0, 0, 0], [160.0, 30.0, 0], [0, 0, 0]])
    scene = scene_of(None, crowd)
    seen = visible_fraction(scene, [sensor_at(rides_on=1002)], np.array([1000, 1001, 1002, 4711]))[0]
    assert seen[0] == 1.0 and np.isnan(seen[1:]).all()


def test_a_world_without_bodies_has_no_fraction() -> None:
    assert fractions(scene_of(ground(), cars([])), sensor_at()).shape == (0,)
    assert np.isnan(visible_fraction(scene_of(ground(), cars([])), [sensor_at()], np.array([4711]))).all()


def test_measuring_draws_no_number_of_the_sensor() -> None:
    sensor = sensor_at()
    fractions(scene_of(None, cars([[12.0, 0, 0]])), sensor)
    assert sensor.rng.random() == np.random.default_rng(0).random()


def test_the_engines_agree() -> None:
    crowd = cars([[15, 0.5, 0.3], [9, 1.5, 0], [-14, 4, 2.0], [-9, 2.4, 1.0]], speed=9.0)
    seen = []
    for engine in ("fused", "public"):
        scene = RayScene(ground(), body_mesh=box_body, engine=engine).with_bodies(crowd)
        seen.append(fractions(scene, sensor_at(spec=ideal("opv2v-64"))))
    np.testing.assert_allclose(*seen, atol=0.005)


def test_a_recording_holds_fractions_in_the_order_of_its_agents_unless_switched_off() -> None:
    traffic = StraightTraffic(cars([[0, 0, 0], [12, 3.5, 0], [12, -3.5, 0], [24.0, -4.0, 0]]))
    world, scenario = ground(), toy_scenario(vehicles=2)
    frame = record(traffic, world, scenario, 1, 1, body_mesh=box_body).frame(0)
    assert frame.visible_fraction.dtype == np.float32
    for row, agent in enumerate(frame.agents):
        own = frame.truth.object_id == agent.agent_id
        assert np.isnan(frame.visible_fraction[row, own]).all()
        assert (frame.visible_fraction[row, ~own] > 0.0).all()
    traffic = StraightTraffic(cars([[0, 0, 0], [12, 3.5, 0]]))
    assert np.isnan(
        record(traffic, world, scenario, 1, 1, body_mesh=box_body, visibility=False).frame(0).visible_fraction
    ).all()


def test_what_is_nearer_than_a_beam_measures_has_no_fraction() -> None:
    near_and_far = scene_of(None, cars([[6.0, 0, 0], [-12.0, 0, 0]]))
    blind = msgspec.structs.replace(FINE, range_min_m=9.0)
    seen = fractions(near_and_far, sensor_at(spec=blind))
    assert np.isnan(seen[0]) and seen[1] == 1.0


@pytest.mark.parametrize(("behind_m", "seen"), [(0.01, 1.0), (0.06, 0.0)])
def test_a_body_that_touches_the_static_world_is_not_hidden_by_it(behind_m: float, seen: float) -> None:
    """A panel 1 m wide, straight ahead, behind the front of a wall at 10 m: tyres touch the road by 2 cm at most."""
    panel = cars([[10.005 + behind_m, 0.0, np.pi / 2]], size=(1.0, 0.01, 1.0))
    assert fractions(scene_of(box((0.5, 40.0, 10.0), (10.25, 0.0, 5.0)), panel)).tolist() == [seen]
