"""Tracks that others recorded become frames, and the frames' truth is the tracks again."""

from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets.render import render
from dsrc.data.formats.opv2v.reader import DriveReader
from dsrc.options.drives import Changes
from sim.errors import ScenarioError, SettingsError
from tests.sim.traffic.tracks.test_tracks import HEADER, write_xml

LANES = {"7": (8.0, 0.0), "12": (-6.0, 4.0), "bike": (3.0, -6.0)}
"""Speed along x, m/s, and y, m."""


def write_tracks(path: Path, times: np.ndarray) -> Path:
    rows = []
    for name, (speed, y) in LANES.items():
        kind, size = ("bicycle", (1.8, 0.6)) if name == "bike" else ("car", (4.5, 1.8))
        yaw = 0.0 if speed > 0 else np.pi
        start = -12.0 * np.sign(speed)
        rows += [f"{t},{name},{start + speed * t},{y},{yaw},{size[0]},{size[1]},{kind}" for t in times]
    path.write_text(HEADER + "\n".join(rows))
    return path


def truth_of(folder: Path) -> list[np.ndarray]:
    reader = DriveReader(folder)
    frames = [reader.read(row) for row in range(len(reader))]
    return [np.column_stack([one.truth.object_id, one.truth.array]) for one in frames]


def test_tracks_become_frames_and_frames_tracks(tmp_path: Path) -> None:
    path = write_tracks(tmp_path / "street.csv", np.array([0.0, 0.17, 0.29, 0.41, 0.6]))
    changes = Changes(lidar="debug-16", agent_id=("12", "7"), frames=4)
    (made,) = render(path, tmp_path / "out", changes)
    assert made.name == "street"
    truth = truth_of(made)
    assert len(truth) == 4
    for step, rows in enumerate(truth):
        for row, (speed, y) in zip(rows, LANES.values(), strict=True):
            place = -12.0 * np.sign(speed) + 0.1 * step * speed
            np.testing.assert_allclose(row[1:3], [place, y], atol=2e-3)
    frame = DriveReader(made).read(0)
    assert {agent.agent_id for agent in frame.agents} == {1000, 1001}
    assert all(len(agent.sweep) > 100 for agent in frame.agents)  # there is ground to see
    assert frame.points_on.max() > 0

    kinds = {1000: ("7", "car"), 1001: ("12", "car"), 1002: ("bike", "bicycle")}
    lines = [
        f"{0.1 * step},{kinds[int(row[0])][0]},{row[1]},{row[2]},{row[3]},{row[7]},{row[4]},{row[5]},{row[6]},"
        f"{kinds[int(row[0])][1]}"
        for step, rows in enumerate(truth)
        for row in rows
    ]
    again = tmp_path / "again.csv"
    again.write_text("time,id,x,y,z,yaw,length,width,height,class\n" + "\n".join(lines))
    (back,) = render(again, tmp_path / "out", Changes(lidar="debug-16", agent_id=("12", "7"), frames=3))
    for before, after in zip(truth, truth_of(back), strict=False):
        np.testing.assert_allclose(after, before, atol=2e-3)


def test_without_ids_those_who_stay_carry_a_lidar(tmp_path: Path) -> None:
    path = write_tracks(tmp_path / "street.csv", np.array([0.0, 0.2]))
    (made,) = render(path, tmp_path / "out", Changes(lidar="debug-16", frames=1))
    assert {agent.agent_id for agent in DriveReader(made).read(0).agents} == {1000, 1001}  # no bicycle


def test_lanelets_are_asphalt_and_the_field_is_not(tmp_path: Path) -> None:
    path = tmp_path / "road.xml"
    write_xml(path)
    (made,) = render(path, tmp_path / "out", Changes(lidar="debug-16", frames=1))
    sweep = DriveReader(made).read(0).agents[0].sweep
    assert len(np.unique(sweep.material[sweep.object_id < 0])) > 1
    world = (sweep.world_from_lidar @ np.column_stack([sweep.points, np.ones(len(sweep))]).T)[:3].T
    on_lane = (sweep.object_id < 0) & (np.abs(world[:, 1] - 2.0) < 1.5) & (np.abs(world[:, 0] - 12.0) < 15.0)
    assert on_lane.any()
    assert len(np.unique(sweep.material[on_lane])) == 1


def test_a_wrong_choice_is_one_line(tmp_path: Path) -> None:
    path = write_tracks(tmp_path / "street.csv", np.array([0.0, 0.2]))
    with pytest.raises(SettingsError, match="agent_id: expected ids of road users in the first frame, found 8"):
        render(path, tmp_path / "out", Changes(agent_id=("8",)))
    with pytest.raises(ScenarioError, match="expected 5 cars or vans"):
        render(path, tmp_path / "out", Changes(vehicles=5, lidar="debug-16"))
