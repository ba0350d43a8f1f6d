"""Spray behind vehicles on a wet road."""

import itertools
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sensors.corruptions import corrupt_frame, spray
from sensors.corruptions.physics.plume import plumes_of
from sensors.corruptions.spray import LIDAR_RATIO_SR, Spray, corrupt
from sensors.frame import Frame
from sensors.recording.rig import Rig
from sensors.sweep import ADDED, ATTENUATED, KEPT, SCATTERED, UNKNOWN_MATERIAL, Sweep
from sim.errors import SettingsError
from sim.geometry import invert, transform_points
from tests.sensors.corruptions.street import same
from tests.sensors.fakes import cars, ground, ideal, scene_of, toy_scenario

EGO, LEADER, OTHER = 1000, 1001, 1002
HEAVY = Spray(water_mm=2.5)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@cache
def drive(speed: float = 22.0, time_s: float = 0.0) -> Frame:
    """An ego behind a leader and a second agent on the other lane; dark ground, nothing else."""
    rows = [[0.0, 0.0, 0.0], [16.0, 0.0, 0.0], [40.0, 4.0, np.pi]]
    actors = cars(rows, speed=[speed, speed, 0.0], time_s=time_s)
    spec = ideal("debug-16", columns=1440, range_10_m=120.0, range_min_m=0.5)
    rig = Rig(toy_scenario(), scene_of(ground(300.0)), 3, vehicle_spec=spec)
    return rig.frame(int(10 * time_s), [EGO, OTHER], actors)


def sweep_of(frame: Frame, agent_id: int = EGO) -> Sweep:
    return frame.agent(agent_id).sweep


def sprayed(frame: Frame, settings: Spray = HEAVY, agent_id: int = EGO, seed: int = 1) -> Sweep:
    row = [agent.agent_id for agent in frame.agents].index(agent_id)
    return corrupt(frame, row, settings, rng(seed))


def test_false_points_hang_in_the_plumes() -> None:
    frame = drive()
    out = sprayed(frame)
    false = out[out.fate == SCATTERED]
    assert len(false) > 100
    assert (false.object_id == ADDED).all() and (false.material == UNKNOWN_MATERIAL).all()
    inside = np.zeros(len(false), bool)
    for plume in plumes_of(frame, HEAVY.water_mm):
        place = transform_points(invert(plume.world_from_plume), false.world_points)
        place[:, 0] += plume.speed * false.time_offset
        low, high = plume.bounds
        inside |= ((place > low - 0.8) & (place < high + 0.8)).all(axis=1)
    assert inside.all()


def test_open_beams_return_spray_and_points_stay_on_their_rays() -> None:
    clean = sweep_of(drive())
    out = sprayed(drive())
    answered = set(zip(clean.ring, clean.column, strict=True))
    false = out[out.fate == SCATTERED]
    new = np.array([pair not in answered for pair in zip(false.ring, false.column, strict=True)])
    assert new.any() and not new.all()
    spec = clean.spec
    azimuth, elevation = spec.azimuth[false.column], spec.elevation[false.ring]
    ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    start = 22.0 * false.time_offset[:, None] * [1.0, 0.0, 0.0]
    toward = false.points - np.where(new[:, None], start, 0.0)
    toward /= np.linalg.norm(toward, axis=1)[:, None]
    assert (toward[new] * ray[new]).sum(axis=1).min() > 1.0 - 1e-4
    rows = {pair: row for row, pair in enumerate(zip(clean.ring, clean.column, strict=True))}
    was = clean.points[[rows[pair] for pair in zip(false.ring[~new], false.column[~new], strict=True)]]
    assert ((was * false.points[~new]).sum(axis=1) / np.linalg.norm(was, axis=1) >= false.range[~new] - 1e-3).all()
    assert (false.range[~new] < np.linalg.norm(was, axis=1)).all()


def test_targets_behind_a_plume_are_dimmed_and_the_rest_unchanged() -> None:
    frame = drive()
    clean, out = sweep_of(frame), sprayed(frame, Spray(water_mm=0.2))
    left = out[out.object_id != ADDED]
    rows = {pair: row for row, pair in enumerate(zip(clean.ring, clean.column, strict=True))}
    was = clean[np.array([rows[pair] for pair in zip(left.ring, left.column, strict=True)])]
    assert (left.points == was.points).all() and (left.intensity <= was.intensity).all()
    kept = left.fate == KEPT
    assert same(left[kept], was[kept])
    leader = left.object_id == LEADER
    assert leader.any() and (left.fate[leader] == ATTENUATED).all()
    share = left.intensity[leader] / was.intensity[leader]
    assert 0.05 < share.mean() < 0.95
    # Ahead of the leader, where the other agent stands, nobody has driven: there the ground is as it was.
    before = sprayed(frame, agent_id=OTHER)
    assert (before.fate[before.world_points[:, 0] > 45.0] == KEPT).all() and (before.fate != KEPT).any()


def test_standing_vehicles_and_dry_roads_have_no_spray() -> None:
    frame = drive(0.0)
    assert same(sprayed(frame), sweep_of(frame))
    assert same(sprayed(drive(), Spray(water_mm=0.0)), sweep_of(drive()))


def test_faster_traffic_is_seen_worse() -> None:
    lost = []
    for speed in (6.0, 12.0, 22.0):
        frame = drive(speed)
        out = sprayed(frame)
        real = out.object_id != ADDED
        lost.append(len(sweep_of(frame)) - out.intensity[real].sum() / sweep_of(frame).intensity.mean())
    assert all(a < b for a, b in itertools.pairwise(lost))


def test_more_water_leaves_less() -> None:
    frame = drive()
    outs = [sprayed(frame, Spray.severity(severity)) for severity in range(1, 6)]
    light = [float(out.intensity[out.object_id != ADDED].sum()) for out in outs]
    assert all(a > b for a, b in itertools.pairwise([float(sweep_of(frame).intensity.sum()), *light]))
    points = [int((out.object_id != ADDED).sum()) for out in outs]
    assert all(a >= b for a, b in itertools.pairwise(points))
    assert (outs[4].fate == SCATTERED).sum() > (outs[1].fate == SCATTERED).sum()


def test_one_seed_gives_the_same_bytes_and_another_other_patches() -> None:
    frame = drive()
    assert same(sprayed(frame), sprayed(frame)) and not same(sprayed(frame), sprayed(frame, seed=2))


def test_two_agents_see_the_same_patches() -> None:
    """Where one agent finds a dense patch the other finds it, too: more often than by chance."""
    frame = corrupt_frame(drive(), "spray", 5, 7)
    other = corrupt_frame(drive(), "spray", 5, 8)

    def cells(made: Frame, agent_id: int) -> set:
        false = sweep_of(made, agent_id)
        false = false[false.fate == SCATTERED]
        return {tuple(cell) for cell in np.floor(false.world_points / 0.4).astype(int)}

    mine, theirs, strange = cells(frame, EGO), cells(frame, OTHER), cells(other, OTHER)
    assert len(theirs) > 20
    assert len(mine & theirs) / len(theirs) > 1.5 * len(mine & strange) / max(len(strange), 1)


def test_an_echo_follows_the_lidar_equation() -> None:
    """Thin, even spray right in front of the sky: pi alpha c tau / 2 / S where the gain is full."""
    out = sprayed(drive(), HEAVY)
    false = out[(out.fate == SCATTERED) & (out.range > 10.0)]
    dense = max(plume.extinction for plume in plumes_of(drive(), HEAVY.water_mm))
    pulse_m = 0.5 * 299_792_458.0 * out.spec.pulse_s
    # Nothing is brighter than the densest patch filling the pulse.
    assert false.intensity.max() < np.pi / LIDAR_RATIO_SR * dense * pulse_m * 8.0
    assert false.intensity.min() >= 1.0 / 255.0 - 1e-6


def test_sweeps_without_points_a_sensor_or_a_neighbour() -> None:
    frame = drive()
    bare = frame.with_sweeps([agent.sweep[:0] for agent in frame.agents])
    out = sprayed(bare)
    assert len(out) > 0 and (out.fate == SCATTERED).all()
    unknown = frame.with_sweeps([replace(agent.sweep, spec=None) for agent in frame.agents])
    assert 0 < len(sprayed(unknown)) <= len(sweep_of(frame))
    one = frame.with_sweeps([replace(agent.sweep[:1], spec=None) for agent in frame.agents])
    assert len(sprayed(one)) <= 1
    with pytest.raises(SettingsError, match="water_mm: expected 0 to 100"):
        Spray(water_mm=-0.1)
    assert Spray(water_mm=1.0).scaled(0.9).water_mm == pytest.approx(0.9)


@pytest.mark.parametrize("turn", [0.0, 0.5, 0.9, 1.0, 1.1, 1.5])
def test_beams_that_are_not_looked_at_lead_to_no_plume(turn: float, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [[0.0, 0.0, turn * np.pi], [16.0, 1.0, 0.3], [-25.0, 4.0, np.pi], [-9.0, -6.0, -2.0]]
    actors = cars(rows, speed=[22.0, 15.0, 25.0, 30.0])
    spec = ideal("debug-16", columns=720, range_10_m=120.0, range_min_m=0.5)
    frame = Rig(toy_scenario(), scene_of(ground(300.0)), 3, vehicle_spec=spec).frame(0, [EGO], actors)
    few = sprayed(frame)
    monkeypatch.setattr(spray, "_rays_toward", lambda plume, start, world_rays: np.arange(len(world_rays.reach)))
    monkeypatch.setattr(spray, "_LEAST_ECHO_DEPTH", 0.0)
    assert (few.fate == SCATTERED).sum() > 100 and same(few, sprayed(frame))
