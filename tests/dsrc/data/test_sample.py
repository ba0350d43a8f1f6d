from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace as changed

from dsrc.data.drives import list_drives
from dsrc.data.formats.opv2v.reader import DriveReader
from dsrc.data.sample import SampleRequest, inside_range, make_sample
from dsrc.models.settings import ModelSettings
from dsrc.ops.grid import GridSpec
from sensors.frame import count_points
from sim.errors import DataError
from sim.geometry import invert, transform_points
from tests.dsrc.data import goldens
from tests.dsrc.data.toy import toy_frame

GRID = GridSpec((-140.8, -40.0, -6.0, 140.8, 40.0, 3.0))


def test_the_golden_tree_gives_the_references_samples(tmp_path: Path) -> None:
    mini, expected = goldens.unpack_opv2v_mini(tmp_path), goldens.load("opv2v_mini_expected")
    frames = [r.read(i) for d in list_drives(mini) for r in [DriveReader(d)] for i in range(len(r))]
    ranges = {"train": GridSpec(), "test": GridSpec((-140.0, -40.0, -3.0, 140.0, 40.0, 1.0))}
    for mode, grid in ranges.items():
        for k, frame in enumerate(frames):
            sample = make_sample(frame, None, SampleRequest(grid, keep_ego_box=True))
            assert sample.boxes.object_id.tolist() == expected[f"{mode}/{k}/object_ids"].tolist()
            want = goldens.ours(expected[f"{mode}/{k}/object_bbx_center"])
            # Ours are upright in the world before they are upright in the ego's frame: second order in the tilt.
            assert (goldens.apart(sample.boxes.array, want) < [1e-5] * 3 + [1e-3] * 3 + [1e-4]).all()
            assert [len(cloud) for cloud in sample.clouds] == expected[f"{mode}/{k}/n_points"].tolist()
            mirror = np.diag([1.0, -1.0, 1.0, 1.0])
            reference = expected[f"{mode}/{k}/transformation_matrix"]
            rows = [[a.agent_id for a in frame.agents].index(i) for i in sample.agent_ids]
            assert np.abs(mirror @ sample.ego_from_agent @ mirror - reference[rows]).max() < 1e-9


def test_the_own_body_rule_of_foreign_data_matches_the_reference() -> None:
    golden, frame = goldens.load("points_in_boxes"), toy_frame(0)
    points = golden["points"] * np.array([1, -1, 1], np.float32)
    sweep = replace(
        frame.agents[0].sweep[np.zeros(len(points), np.int64)], points=points, spec=None, world_from_lidar=np.eye(4)
    )
    frame = frame.of_agents([0]).with_sweeps([sweep])
    sample = make_sample(frame, 1000, GridSpec((-10.0, -6.0, -2.0, 10.0, 6.0, 0.5)))
    kept = points[golden["in_range"] & ~golden["in_ego_body"]]
    assert np.array_equal(sample.clouds[0][:, :3], kept)


def test_the_ego_is_the_first_vehicle_and_comes_first() -> None:
    frame = toy_frame(0)
    assert make_sample(frame, None, GRID).agent_ids == (1000, 1002, -1)
    assert make_sample(frame, 1002, GRID).agent_ids == (1002, 1000, -1)
    assert make_sample(frame, -1, GRID).agent_ids == (-1, 1000, 1002)
    with pytest.raises(DataError, match=r"ego: expected one of the agents \[1000, 1002, -1\], found 5"):
        make_sample(frame, 5, GRID)


def test_agents_out_of_range_or_over_the_limit_do_not_take_part() -> None:
    frame = toy_frame(0)
    assert make_sample(frame, None, SampleRequest(GRID, comm_range_m=25.0)).agent_ids == (1000, -1)
    assert make_sample(frame, None, SampleRequest(GRID, comm_range_m=0.0)).agent_ids == (1000,)
    assert make_sample(frame, None, SampleRequest(GRID, max_agents=2)).agent_ids == (1000, 1002)


def test_by_folders_an_agent_out_of_range_takes_the_place_of_one_in_range() -> None:
    frame = toy_frame(0)  # the second folder's agent is 30 m away, the third's 25 m
    assert make_sample(frame, None, SampleRequest(GRID, comm_range_m=25.0, max_agents=2)).agent_ids == (1000, -1)
    assert make_sample(
        frame, None, SampleRequest(GRID, comm_range_m=25.0, max_agents=2, team_by="folders")
    ).agent_ids == (1000,)
    assert make_sample(frame, None, SampleRequest(GRID, comm_range_m=25.0, team_by="folders")).agent_ids == (1000, -1)
    assert make_sample(frame, -1, SampleRequest(GRID, max_agents=2, team_by="folders")).agent_ids == (-1, 1000)


def test_opencood_judges_by_its_own_range_whatever_the_detectors(tmp_path: Path) -> None:
    mini, expected = goldens.unpack_opv2v_mini(tmp_path), goldens.load("opv2v_mini_expected")
    frames = [r.read(i) for d in list_drives(mini) for r in [DriveReader(d)] for i in range(len(r))]
    small = ModelSettings(grid=GridSpec((-51.2, -25.6, -3.0, 51.2, 25.6, 1.0)), judged_by="opencood")
    beyond = 0
    for k, frame in enumerate(frames):
        sample = make_sample(frame, None, small.request)
        own = make_sample(frame, None, changed(small, judged_by="grid").request)
        assert sample.boxes.object_id.tolist() == expected[f"test/{k}/object_ids"].tolist()
        assert set(own.boxes.object_id.tolist()) <= set(sample.boxes.object_id.tolist())
        assert [len(cloud) for cloud in sample.clouds] == [len(cloud) for cloud in own.clouds]
        beyond += len(sample.boxes) - len(own.boxes)
    assert beyond > 5


def test_a_sample_is_made_as_the_settings_of_its_detector_say() -> None:
    frame = toy_frame(0)
    with pytest.warns(FutureWarning, match="SampleRequest"):
        assert make_sample(frame, None, GRID, max_agents=1).agent_ids == (1000,)
    two = ModelSettings(grid=GridSpec((-140.8, -40.0, -6.0, 140.8, 40.0, 2.8)), rec=False, max_agents=2)
    assert make_sample(frame, 1002, two.request).agent_ids == (1002, 1000)
    assert make_sample(frame, None, two.request, cooperative=False).agent_ids == (1000,)


def test_clouds_of_all_agents_lie_on_the_same_objects() -> None:
    frame = toy_frame(3)
    sample = make_sample(frame, None, GRID)
    assert np.array_equal(sample.ego_from_agent[0], np.eye(4))
    for agent, cloud, boxes in zip(frame.agents, sample.clouds, sample.agent_boxes, strict=True):
        inside = boxes.contains(cloud[:, :3], 0.01).sum(axis=1)
        assert (inside >= count_points(agent.sweep, boxes.object_id)).all()
        assert cloud.dtype == np.float32 and cloud.flags.c_contiguous


def test_boxes_are_vehicles_with_a_point_of_any_agent_without_the_ego() -> None:
    sample = make_sample(toy_frame(0), None, GRID)
    assert sample.boxes.object_id.tolist() == [1001, 1002, 1004]
    assert [b.object_id.tolist() for b in sample.agent_boxes] == [[1001, 1002, 1004], [1001], [1001, 1002, 1004]]
    kept = make_sample(toy_frame(0), None, SampleRequest(GRID, keep_ego_box=True))
    assert kept.boxes.object_id.tolist() == [1000, 1001, 1002, 1004]


def test_vulnerable_road_users_are_another_ground_truth_of_the_same_clouds() -> None:
    vehicles, others = (
        make_sample(toy_frame(0), None, SampleRequest(GRID, users=users)) for users in ("vehicles", "vulnerable")
    )
    assert others.boxes.object_id.tolist() == [1003]  # a pedestrian
    assert all((one == other).all() for one, other in zip(vehicles.clouds, others.clouds, strict=True))


def test_the_ground_truth_of_the_ego_alone_is_that_of_all_agents() -> None:
    frame = toy_frame(0)
    alone = make_sample(frame, 1002, GRID, cooperative=False)
    assert alone.agent_ids == (1002,) and len(alone.clouds) == len(alone.agent_boxes) == len(alone.ego_from_agent) == 1
    assert alone.boxes.object_id.tolist() == make_sample(frame, 1002, GRID).boxes.object_id.tolist()


def test_only_whole_boxes_in_range_count_and_points_strictly_inside() -> None:
    grid = GridSpec((-30.0, -10.0, -3.0, 22.0, 10.0, 3.0))
    sample = make_sample(toy_frame(0), None, grid)
    assert 1001 not in sample.boxes.object_id  # its far end reaches beyond x = 22
    assert inside_range(sample.boxes, grid).all()
    for cloud in sample.clouds:
        assert (cloud[:, :3] > grid.range_m[:3]).all() and (cloud[:, :3] < grid.range_m[3:]).all()


def test_our_own_sweeps_lose_points_on_the_true_body_only() -> None:
    frame = toy_frame(0)
    agent, truth = frame.agents[0], frame.truth
    body = truth[truth.object_id == 1000].transform(invert(agent.sweep.world_from_lidar))
    tail = np.array([[-2.1, 0.0, -1.2], [2.6, 0.0, -1.2], [0.0, 3.0, -1.2]], np.float32)
    sweep = replace(agent.sweep[:3], points=tail)
    frame = replace(frame, agents=(replace(agent, sweep=sweep), *frame.agents[1:]))
    assert body.contains(tail).tolist() == [[True, False, False]]
    assert make_sample(frame, None, GRID).clouds[0][:, :3].tolist() == tail[1:].tolist()


def test_a_frame_without_agents_is_refused_and_one_without_points_is_not() -> None:
    frame = toy_frame(0)
    with pytest.raises(DataError, match="at least one agent"):
        make_sample(frame.of_agents([]), None, GRID)
    silent = frame.with_sweeps([a.sweep[:0] for a in frame.agents])
    assert [c.shape for c in make_sample(silent, None, GRID).clouds] == [(0, 4)] * 3


def test_points_stay_where_the_world_has_them() -> None:
    frame = toy_frame(2)
    sample = make_sample(frame, None, GRID)
    world = transform_points(frame.agents[0].sweep.world_from_lidar, sample.clouds[1][:, :3].astype(np.float64))
    source = frame.agents[1].sweep.world_points
    nearest = np.array([np.abs(source - p).max(axis=1).min() for p in world])
    assert nearest.max() < 1e-4


def test_a_frame_that_lies_ahead_holds_the_same_scene() -> None:
    frame, ahead_m = toy_frame(0), 12.0
    near, far = make_sample(frame, None, GRID), make_sample(frame, None, GRID, ahead_m=ahead_m)
    shift = np.array([ahead_m, 0.0, 0.0])
    assert near.agent_ids == far.agent_ids
    np.testing.assert_allclose(far.ego_from_agent[:, :3, 3] + shift, near.ego_from_agent[:, :3, 3])
    for one, other in zip(near.clouds, far.clouds, strict=True):
        inside = [
            cloud[np.abs(cloud[:, 0] + by) < 120.0, :3] + [move, 0, 0]
            for cloud, by, move in ((one, 0.0, 0.0), (other, ahead_m, ahead_m))
        ]
        np.testing.assert_allclose(*inside, atol=1e-4)
    np.testing.assert_allclose(far.boxes.center + shift, near.boxes.center)
