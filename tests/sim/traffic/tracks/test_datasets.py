"""Files in the formats of INTERACTION, inD and highD, written after their specifications; no library writes them.

Sources: README of the INTERACTION dataset (versions 1.1 and 1.2); the format pages of levelxdata.com.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets.render import render
from dsrc.options.drives import Changes
from sim.errors import DataError
from sim.traffic.tracks.base import Track
from sim.traffic.tracks.open import read_tracks

VEHICLES = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width"
PEDESTRIANS = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy"
CASES = f"case_id,{VEHICLES}"


def by_name(path: Path) -> dict[str, Track]:
    (recording,) = read_tracks(path)
    return {one.name: one for one in recording.tracks}


def vehicle(name: str, x: float, yaw: float = 0.0, length: float = 4.5, lead: str = "") -> list[str]:
    """Two seconds at 10 m/s along its heading."""
    return [
        f"{lead}{name},{k + 1},{100 * (k + 1)},car,{x + k * math.cos(yaw)},{k * math.sin(yaw)},10,0,{yaw},{length},1.8"
        for k in range(20)
    ]


def write_interaction(path: Path) -> None:
    """Three vehicles, and beside their file that of one who walks and one who rides."""
    path.write_text("\n".join([VEHICLES, *vehicle("1", 0.0), *vehicle("2", 30.0, 2.5), *vehicle("3", 60.0, 0.0, 12.0)]))
    walks = [f"P1,{k},{100 * k},pedestrian/bicycle,5.0,{-0.14 * k},0,-1.4" for k in range(1, 21)]
    rides = [f"P2,{k},{100 * k},pedestrian/bicycle,{0.5 * k},8.0,5,0" for k in range(1, 21)]
    path.with_name("pedestrian_tracks_000.csv").write_text("\n".join([PEDESTRIANS, *walks, *rides]))


def test_interaction_joins_vehicles_and_pedestrians(tmp_path: Path) -> None:
    path = tmp_path / "vehicle_tracks_000.csv"
    write_interaction(path)
    tracks = by_name(path)
    kinds = {name: one.class_name for name, one in tracks.items()}
    assert kinds == {"1": "car", "2": "car", "3": "truck", "P1": "pedestrian", "P2": "bicycle"}
    np.testing.assert_allclose(tracks["2"].center[3, :2], [30 + 3 * math.cos(2.5), 3 * math.sin(2.5)])
    np.testing.assert_allclose(tracks["2"].time_s, 0.1 * np.arange(1, 21))
    np.testing.assert_allclose(tracks["2"].yaw, 2.5)
    np.testing.assert_allclose(tracks["P1"].yaw, -0.5 * math.pi)
    np.testing.assert_allclose(tracks["P2"].yaw, 0.0)


def test_cases_of_interaction_are_drives_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "DR_USA_train.csv"
    walks = [f"2.0,9,{k},{100 * k},pedestrian/bicycle,5.0,{0.14 * k},0,1.4,,," for k in range(1, 21)]
    rows = [*vehicle("1", 0.0, lead="1.0,"), *vehicle("1", 40.0, 1.0, lead="2.0,"), *walks]
    path.write_text("\n".join([CASES, *rows]))
    first, second = read_tracks(path)
    assert (first.part, second.part) == ("case_1", "case_2")
    assert [one.name for one in first.tracks] == ["1"]
    assert [one.name for one in second.tracks] == ["1", "9"]
    assert second.tracks[0].center[0, 0] == 40.0
    np.testing.assert_allclose(second.tracks[1].yaw, 0.5 * math.pi)
    made = render(path, tmp_path / "out", Changes(lidar="debug-16", frames=1))
    assert [folder.relative_to(tmp_path / "out") for folder in made] == [
        Path("DR_USA_train/case_1"),
        Path("DR_USA_train/case_2"),
    ]


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ([f"{VEHICLES}", "1,1,100,car,0,0,1,0,95,4,2"], "psi_rad: expected radians within 2 pi, found 95"),
        ([f"{PEDESTRIANS}", "1,1,100,car,0,0,1,0"], "expected psi_rad, length and width of a vehicle"),
        ([f"{VEHICLES}", "1,1,now,car,0,0,1,0,0,4,2"], "line 2, timestamp_ms: expected a number, found now"),
        ([f"{VEHICLES}", "1,1,100,tank,0,0,1,0,0,4,2"], "agent_type: expected a class of road user, found tank"),
    ],
)
def test_a_wrong_file_of_interaction_is_one_line(tmp_path: Path, rows: list[str], says: str) -> None:
    path = tmp_path / "vehicle_tracks_000.csv"
    path.write_text("\n".join(rows))
    with pytest.raises(DataError) as wrong:
        read_tracks(path)
    assert says in str(wrong.value)


def write_ind(folder: Path) -> Path:
    """Two vehicles, one to the north-west, and a pedestrian, which has no box, at 25 Hz."""
    head = "recordingId,trackId,frame,trackLifetime,xCenter,yCenter,heading,width,length,xVelocity,yVelocity"
    lines = [head]
    for k in range(50):
        step = 8.0 * k / 25.0
        lines.append(f"7,0,{k + 10},{k},{20 + step},-40,0.0,1.9,4.7,8,0")
        lines.append(f"7,1,{k},{k},{60 - step * 0.6},{-50 + step * 0.8},{126.8698976},2.5,11.0,-4.8,6.4")
        lines.append(f"7,2,{k},{k},30,{-45 - 1.3 * k / 25.0},0.0,0.0,0.0,0,-1.3")
    (folder / "07_tracks.csv").write_text("\n".join(lines))
    meta = "recordingId,trackId,initialFrame,finalFrame,numFrames,width,length,class"
    rows = ["7,0,10,59,50,1.9,4.7,car", "7,1,0,49,50,2.5,11.0,truck_bus", "7,2,0,49,50,0.0,0.0,pedestrian"]
    (folder / "07_tracksMeta.csv").write_text("\n".join([meta, *rows]))
    (folder / "07_recordingMeta.csv").write_text(
        "recordingId,locationId,frameRate,speedLimit,weekday,xUtmOrigin,yUtmOrigin\n7,1,25,13.89,monday,5e5,5.6e6"
    )
    return folder / "07_tracks.csv"


def test_ind_counts_frames_and_headings_in_degrees(tmp_path: Path) -> None:
    tracks = by_name(write_ind(tmp_path))
    assert {name: one.class_name for name, one in tracks.items()} == {"0": "car", "1": "truck", "2": "pedestrian"}
    np.testing.assert_allclose(tracks["0"].time_s, np.arange(10, 60) / 25.0)
    np.testing.assert_allclose(tracks["1"].center[25, :2], [60 - 4.8, -50 + 6.4])
    np.testing.assert_allclose(tracks["1"].yaw, math.atan2(0.8, -0.6))
    np.testing.assert_allclose(tracks["1"].size[:2], [11.0, 2.5])
    np.testing.assert_allclose(tracks["2"].yaw, -0.5 * math.pi)
    assert (tracks["2"].size > 0.4).all()


def write_highd(folder: Path) -> Path:
    """One to the left on the upper carriageway of the picture, one to the right on the lower, y downwards."""
    head = "frame,id,x,y,width,height,xVelocity,yVelocity,xAcceleration,yAcceleration,laneId"
    lines = [head]
    for k in range(50):
        step = 30.0 * k / 25.0
        lines.append(f"{k + 1},1,{300 - step},8.0,4.6,2.0,-30,0,0,0,2")
        lines.append(f"{k + 1},2,{50 + step},26.0,12.4,2.5,30,0,0,0,6")
    (folder / "01_tracks.csv").write_text("\n".join(lines))
    meta = "id,width,height,initialFrame,finalFrame,numFrames,class,drivingDirection"
    rows = ["1,4.6,2.0,1,50,50,Car,1", "2,12.4,2.5,1,50,50,Truck,2"]
    (folder / "01_tracksMeta.csv").write_text("\n".join([meta, *rows]))
    (folder / "01_recordingMeta.csv").write_text(
        "id,frameRate,locationId,speedLimit,upperLaneMarkings,lowerLaneMarkings\n"
        "1,25,2,-1.00,7.00;10.80;14.50,21.00;24.90;29.10"
    )
    return folder / "01_tracks.csv"


def test_highd_has_corners_and_a_picture_s_y(tmp_path: Path) -> None:
    (recording,) = read_tracks(write_highd(tmp_path))
    left, right = recording.tracks
    assert (left.class_name, right.class_name) == ("car", "truck")
    np.testing.assert_allclose(left.center[0, :2], [302.3, -9.0])
    np.testing.assert_allclose(right.center[25, :2], [50 + 30 + 6.2, -27.25])
    assert abs(abs(left.yaw[0]) - math.pi) < 1e-9 and right.yaw[0] == 0.0
    np.testing.assert_allclose(right.size[:2], [12.4, 2.5])
    assert len(recording.lanes) == 4
    for one in (left, right):  # vehicles keep to the right of the middle, on a lane
        inside = [
            outline for outline in recording.lanes if outline[:, 1].min() < one.center[0, 1] < outline[:, 1].max()
        ]
        assert len(inside) == 1
    assert np.diff(recording.lanes[0][:, 1]).min() < 0


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("07_tracksMeta.csv", None, "07_tracksMeta.csv: file not found"),
        ("07_recordingMeta.csv", None, "07_recordingMeta.csv: file not found"),
        ("07_recordingMeta.csv", (",25,", ",0,"), "frameRate: expected one rate"),
        ("07_tracksMeta.csv", ("7,1,0,49", "7,5,0,49"), "tracks: expected object '1' of the tracks"),
        ("07_tracks.csv", ("126.8698976", "1268"), "object '1': heading: expected degrees within 360, found 1268"),
    ],
)
def test_a_wrong_file_of_ind_is_one_line(tmp_path: Path, name: str, change: tuple[str, str] | None, says: str) -> None:
    path = write_ind(tmp_path)
    if change is None:
        (tmp_path / name).unlink()
    else:
        text = (tmp_path / name).read_text()
        assert change[0] in text
        (tmp_path / name).write_text(text.replace(*change))
    with pytest.raises(DataError) as wrong:
        read_tracks(path)
    assert says in str(wrong.value)
    assert "\n" not in str(wrong.value)
