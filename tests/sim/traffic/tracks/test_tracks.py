"""Track files of others: each format gives the same traffic, in between is interpolated, gaps are named."""

import logging
import pickle  # noqa: TID251 -- the file that a user has is one
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sim.errors import DataError
from sim.traffic.tracks.base import to_log
from sim.traffic.tracks.open import read_tracks
from tests.paths import ROOT

HEADER = "time,id,x,y,yaw,length,width,class\n"
TIMES = np.array([0.0, 0.13, 0.31, 0.5, 0.58, 0.9, 1.0])
SIZE = (4.5, 1.8)
CLASS = "car"


def pose(time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Straight on at 10 m/s, turning through the angle at which headings wrap."""
    return 10.0 * time_s, np.full_like(time_s, 2.0), np.pi - 0.2 + 0.4 * time_s


def write_csv(path: Path) -> None:
    rows = [f"{t},7,{x},{y},{(yaw + np.pi) % (2 * np.pi) - np.pi},4.5,1.8,Car" for t, x, y, yaw in samples()]
    path.write_text(HEADER + "\n".join(reversed(rows)) + "\n")


def write_npz(path: Path) -> None:
    x, y, yaw = pose(TIMES)
    place = np.stack([np.column_stack([x, y]), np.zeros((len(TIMES), 2))])
    np.savez(
        path,
        time=TIMES,
        id=np.array(["7", "cone"]),
        type=np.array(["VEHICLE", "TRAFFIC_CONE"]),
        position=place,
        heading=np.stack([yaw, yaw]),
        length=np.array([SIZE[0], 0.3]),
        width=np.array([SIZE[1], 0.3]),
        valid=np.ones((2, len(TIMES)), bool),
    )


def write_xml(path: Path, version: str = "2020a") -> None:
    """Steps of 10 ms; the rectangle lies 1 m ahead of the position."""

    def state(tag: str, time_s: float, x: float, y: float, yaw: float) -> str:
        return (
            f"<{tag}><position><point><x>{x - np.cos(yaw)}</x><y>{y - np.sin(yaw)}</y></point></position>"
            f"<orientation><exact>{yaw}</exact></orientation><time><exact>{round(100 * time_s)}</exact></time></{tag}>"
        )

    first, *others = samples()
    shape = "<shape><rectangle><length>4.5</length><width>1.8</width><center><x>1</x><y>0</y></center></rectangle>"
    states = state("initialState", *first) + "<trajectory>" + "".join(state("state", *one) for one in others)
    opening, closing = (
        ('<dynamicObstacle id="7">', "</dynamicObstacle>")
        if version == "2020a"
        else ('<obstacle id="7"><role>dynamic</role>', "</obstacle>")
    )
    bounds = "".join(
        f"<{side}><point><x>-5</x><y>{y}</y></point><point><x>30</x><y>{y}</y></point></{side}>"
        for side, y in (("leftBound", 4), ("rightBound", 0))
    )
    path.write_text(
        f'<commonRoad commonRoadVersion="{version}" timeStepSize="0.01"><lanelet id="1">{bounds}</lanelet>'
        f"{opening}<type>car</type>{shape}</shape>{states}</trajectory>{closing}</commonRoad>"
    )


def samples() -> list[tuple[float, float, float, float]]:
    return [tuple(map(float, row)) for row in zip(TIMES, *pose(TIMES), strict=True)]  # type: ignore[misc]


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("tracks.csv", write_csv),
        ("tracks.npz", write_npz),
        ("tracks.xml", write_xml),
        ("old.xml", lambda path: write_xml(path, "2018b")),
    ],
)
def test_every_format_gives_the_motion_at_every_step(tmp_path: Path, name: str, write: Callable[[Path], None]) -> None:
    path = tmp_path / name
    write(path)
    (recording,) = read_tracks(path)
    log = to_log(path, recording)
    assert [one.name for one in recording.tracks] == ["7"]
    assert len(recording.lanes) == name.endswith("xml")
    assert len(log) == 11
    for step in range(len(log)):
        actors = log[step]
        x, y, yaw = (float(value[0]) for value in pose(np.array([0.1 * step])))
        np.testing.assert_allclose(actors.boxes.center[0, :2], [x, y], atol=1e-3)
        turn = float(actors.boxes.yaw[0]) - yaw
        assert abs((turn + np.pi) % (2 * np.pi) - np.pi) < 2e-5  # by the shortest arc, never the long way round
        np.testing.assert_allclose(actors.boxes.size[0], [*SIZE, 1.5])
        assert actors.boxes.center[0, 2] == 0.75  # it stands on the ground
        np.testing.assert_allclose(actors.velocity[0], [10.0, 0.0], atol=0.02)


def test_what_the_page_of_formats_writes_of_a_scenario_of_scenarionet_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """States as MetaDrive's scenario_description.py says and ScenarioNet's converter of nuPlan fills them in.

    Sizes are (T, 1), `valid` is 0.0 or 1.0, and values of steps that are not valid are 0.
    """
    x, y, yaw = pose(TIMES)
    steps, there = len(TIMES), np.array([0.0, *np.ones(len(TIMES) - 1)])

    def track(kind: str, length: float, width: float, turn: float = 0.0) -> dict:
        size = {"length": length, "width": width, "height": 1.6}
        state = {name: np.reshape(there * value, (steps, 1)) for name, value in size.items()}
        place = np.column_stack([x, y, np.zeros(steps)]) * there[:, None]
        state |= {"position": place, "heading": (yaw + turn) * there, "valid": there, "velocity": np.zeros((steps, 2))}
        return {"type": kind, "state": state, "metadata": {"type": kind, "object_id": kind}}

    tracks = {"ego": track("VEHICLE", *SIZE), "a1": track("CYCLIST", 1.8, 0.6), "b2": track("TRAFFIC_OBJECT", 1.0, 1.0)}
    scenario = {"tracks": tracks, "length": steps, "metadata": {"ts": TIMES, "coordinate": "metadrive"}}
    (tmp_path / "scenario.pkl").write_bytes(pickle.dumps(scenario))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match=r"found \.pkl; a pickle can run code, docs/formats.md says how"):
        read_tracks(Path("scenario.pkl"))
    section = (ROOT / "docs" / "formats.md").read_text().split("\n## ScenarioNet\n")[1].split("\n## ")[0]
    (block,) = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    assert block.count("\n") <= 10
    exec(block, {})
    (recording,) = read_tracks(Path("tracks.npz"))
    assert [(one.name, one.class_name) for one in recording.tracks] == [("ego", "car"), ("a1", "bicycle")]
    ego = recording.tracks[0]
    np.testing.assert_allclose(ego.size, [*SIZE, 1.6])
    np.testing.assert_array_equal(ego.time_s, TIMES[1:])
    np.testing.assert_allclose(ego.center[:, :2], np.column_stack([x, y])[1:])
    assert not caplog.records
    tracks["ego"] = track("VEHICLE", *SIZE, turn=-np.pi / 2)
    (tmp_path / "scenario.pkl").write_bytes(pickle.dumps(scenario))
    caplog.clear()
    exec(block, {})
    read_tracks(Path("tracks.npz"))
    assert "headings of 1 of 2 moving vehicles disagree with their motion, such as object 'ego' by 86" in caplog.text


@pytest.mark.parametrize("written", ["semicolons", "tabs", "quotes"])
def test_a_csv_as_spreadsheets_write_it_is_the_same(tmp_path: Path, written: str) -> None:
    """A byte order mark, CRLF, columns more than needed; semicolons stand where a comma begins the decimals."""
    write_csv(tmp_path / "plain.csv")
    rows = [
        f"{line},{'note' if k == 0 else '1.5'}" for k, line in enumerate((tmp_path / "plain.csv").read_text().split())
    ]
    separated = {
        "semicolons": [row.replace(",", ";").replace(".", ",") for row in rows],
        "tabs": [row.replace(",", "\t") for row in rows],
        "quotes": [",".join(f'"{cell}"' for cell in row.split(",")) for row in rows],
    }
    (tmp_path / "other.csv").write_text("\ufeff" + "\r\n".join(separated[written]) + "\r\n", newline="")
    (plain,), (other,) = read_tracks(tmp_path / "plain.csv"), read_tracks(tmp_path / "other.csv")
    assert len(plain.tracks) == len(other.tracks) > 0
    for one, two in zip(plain.tracks, other.tracks, strict=True):
        np.testing.assert_array_equal(one.center, two.center)
        np.testing.assert_array_equal(one.yaw, two.yaw)


def test_a_gap_is_named_and_nobody_is_there(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "gap.csv"
    rows = [
        f"{t:.1f},{name},{t},0,0,4,2,car"
        for name, times in (("a", (0, 0.5, 3, 3.5)), ("b", (0, 1, 2, 3)))
        for t in times
    ]
    path.write_text(HEADER + "\n".join(rows))
    with caplog.at_level(logging.WARNING):
        log = to_log(path, *read_tracks(path))
    assert ["a" in log[step].name for step in (0, 5, 6, 29, 30, 35)] == [True, True, False, False, True, True]
    assert all("b" in log[step].name for step in range(31))
    (line,) = [record.getMessage() for record in caplog.records]
    assert "object 'a': no samples from 0.50 s to 3.00 s" in line


def test_a_jump_is_named_and_gives_no_speed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "jump.csv"
    rows = [f"{t:.1f},a,{10 * t + (500 if t > 0.45 else 0)},0,0,4,2,car" for t in np.arange(0.0, 1.0, 0.1)]
    path.write_text(HEADER + "\n".join(rows))
    with caplog.at_level(logging.WARNING):
        log = to_log(path, *read_tracks(path))
    (line,) = [record.getMessage() for record in caplog.records]
    assert "object 'a': jumps, 1 in all, the first of 501 m from 0.40 s to 0.50 s: its motion is cut there" in line
    assert all("a" in log[step].name for step in range(10))
    np.testing.assert_allclose([log[step].velocity[0, 0] for step in range(10)], 10.0, atol=1e-6)


def test_places_in_degrees_and_times_in_milliseconds_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "units.csv"
    rows = [(t, name, k) for t in np.arange(0.0, 1.0, 0.1) for k, name in enumerate("ab")]
    path.write_text(HEADER + "\n".join(f"{t},{name},{48 + 1e-4 * t},{11 + 5e-5 * k},0,4,2,car" for t, name, k in rows))
    with pytest.raises(DataError, match="x, y: expected metres, found 2 vehicles within 9e-05; are they in degrees"):
        read_tracks(path)
    for steps, told in ((10, "most samples at most 1 s apart, found 100 s"), (100, "at most 3600 .* found 9900")):
        path.write_text(HEADER + "\n".join(f"{100 * k},a,{k},0,0,4,2,car" for k in range(steps)))
        with pytest.raises(DataError, match=rf"time: expected seconds, {told}; is it in milliseconds"):
            to_log(path, *read_tracks(path))


def test_a_standing_car_that_gets_a_new_id_is_in_metres(tmp_path: Path) -> None:
    path = tmp_path / "parked.csv"
    path.write_text(HEADER + "\n".join(f"{0.1 * k:.1f},{'ab'[k > 4]},{0.003 * k},0,0,4,2,car" for k in range(10)))
    assert len(read_tracks(path)[0].tracks) == 2


@pytest.mark.parametrize("begin_s", [0.0, 0.03, 1.6e9])
def test_no_step_lies_between_the_places_of_a_jump(tmp_path: Path, begin_s: float) -> None:
    path = tmp_path / "origin.csv"
    rows = [f"{begin_s + 0.1 * k:.6f},a,{(3e5 + k, 0)[k == 7]},{(5e6, 0)[k == 7]},0,4,2,car" for k in range(12)]
    rows.append(f"{begin_s + 0.75:.6f},b,3e5,5e6,0,4,2,car\n{begin_s + 1.15:.6f},b,3e5,5e6,0,4,2,car")
    path.write_text(HEADER + "\n".join(rows))
    log = to_log(path, *read_tracks(path))
    places = [log[step].boxes.center[list(log[step].name).index("a")] for step in range(12)]
    assert all(np.hypot(*place[:2]) < 1.0 or abs(place[1] - 5e6) < 1.0 for place in places)
    speed = [log[step].velocity[list(log[step].name).index("a"), 0] for step in range(12)]
    np.testing.assert_allclose(np.delete(speed, 7), 10.0, atol=1e-3)


def test_heights_are_kept_and_the_ground_is_where_they_stand(tmp_path: Path) -> None:
    path = tmp_path / "hill.csv"
    rows = "\n".join(f"{t},{name},{t},0,101.0,0,4,2,2.0,car" for name in "ab" for t in (0.0, 1.0))
    path.write_text(HEADER.replace("y,yaw", "y,z,yaw").replace("width", "width,height") + rows)
    (recording,) = read_tracks(path)
    assert recording.ground_m == 100.0
    np.testing.assert_array_equal(to_log(path, recording)[3].boxes.center[:, 2], [101.0, 101.0])


def turning(way_yaw: float, yaw: float, speed: float = 8.0) -> str:
    rows = [
        f"{0.1 * k},7,{0.1 * k * speed * np.cos(way_yaw)},{0.1 * k * speed * np.sin(way_yaw)},{yaw},4,2,car"
        for k in range(20)
    ]
    return HEADER + "\n".join(rows)


@pytest.mark.parametrize(
    ("way", "yaw", "speed", "warned"),
    [
        (0.7, 0.75, 8.0, False),
        (0.7, 0.7 - np.pi, 8.0, False),  # it drives backwards
        (0.7, np.pi / 2 - 0.7 + 2.0, 8.0, True),
        (0.0, np.pi / 2, 8.0, True),  # a compass's north
        (0.0, np.pi / 2, 0.05, False),  # it stands
    ],
)
def test_a_heading_across_the_motion_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, way: float, yaw: float, speed: float, warned: bool
) -> None:
    path = tmp_path / "a.csv"
    path.write_text(turning(way, yaw, speed))
    with caplog.at_level(logging.WARNING):
        read_tracks(path)
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == warned
    assert all("1 of 1 moving vehicles disagree" in line and "object '7'" in line for line in lines)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.csv", "time,id,x,y,yaw,length,width\n", "columns: expected a column 'class'"),
        ("a.csv", HEADER + "0,1,zero,0,0,4,2,car", "line 2, x: expected a number, found zero"),
        ("a.csv", HEADER + "0,1,0,0,180,4,2,car", "object '1': yaw: expected radians within 2 pi, found 180"),
        (
            "a.xml",
            '<commonRoad commonRoadVersion="2020a" timeStepSize="0.1"><dynamicObstacle id="3"><type>car</type><shape>'
            "<circle><radius>1</radius></circle></shape><initialState><position><point><x>0</x><y>0</y></point>"
            "</position><orientation><exact>-90</exact></orientation><time><exact>0</exact></time></initialState>"
            "</dynamicObstacle></commonRoad>",
            "obstacle 3: orientation: expected radians within 2 pi, found -90",
        ),
        ("a.csv", HEADER + "0,1,0,0,0,4,2,tank", "line 2, class: expected a class of road user, found tank"),
        ("a.csv", HEADER + "0,1,0,0,0,4,0,car", "object '1': size: expected three lengths"),
        ("a.csv", HEADER + "0,1,0,0,0,4,2,car\n0,1,1,0,0,4,2,car", "object '1': time: expected each time once"),
        ("a.csv", HEADER + "0,1,0,0,0,4,2,car\n1,1,1,0,0,4,2,bus", "line 3, class: expected 'car'"),
        ("a.csv", HEADER + "0,1,0,0,0,4,2,car\n1e9,1,1,0,0,4,2,car", "time: expected seconds, at most 3600"),
        ("a.csv", HEADER, "tracks: expected at least one road user, found none"),
        ("a.csv", HEADER + "0,,0,0,0,4,2,car", "line 2, id: expected an id"),
        ("a.csv", HEADER + "0,1,0,0,0,4,2,car\n\n1,1,1,0,0,4,2", "line 4: expected 8 values, as columns, found 7"),
        ("a.csv", HEADER + "0,1,0,0,0,4,2,car,1,2", "line 2: expected 8 values, as columns, found 10"),
        ("a.npz", "no archive", "track file"),
        ("a.xml", "<commonRoad", "root: expected <commonRoad>"),
        ("a.xml", '<commonRoad commonRoadVersion="2017a"/>', "<commonRoad> of version 2018b or 2020a, found <comm"),
        ("a.xml", "<osm/>", "root: expected <commonRoad> or <fcd-export> or <OpenSCENARIO>, found <osm>"),
        ("a.xml", '<commonRoad commonRoadVersion="2020a"/>', "timeStepSize: expected a number"),
        (
            "a.xml",
            '<commonRoad commonRoadVersion="2020a" timeStepSize="0.1"><dynamicObstacle id="3"><type>car</type>'
            "<shape><circle/></shape></dynamicObstacle></commonRoad>",
            "obstacle 3: radius: expected a number, found nothing",
        ),
        ("a.txt", "", "expected a file that ends with .csv, .npz, .xml"),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path: Path, name: str, text: str, says: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(DataError) as wrong:
        to_log(path, *read_tracks(path))
    assert says in str(wrong.value)
    assert "\n" not in str(wrong.value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"heading": np.zeros((2, 3))}, "heading: expected shape (2, 7)"),
        ({"position": np.zeros((2, 7, 4))}, "position: expected shape (2, 7) x 2 or 3"),
        ({"valid": np.ones((2, 7))}, "valid: expected booleans"),
        ({"heading": np.full((2, 7), 90.0)}, "heading[0]: expected radians within 2 pi, found 90"),
        ({"type": np.array([{}, {}], object)}, "allow_pickle=False"),
        ({"id": np.array(["7", "7"]), "type": np.array(["car", "car"])}, "id: expected ids that differ"),
    ],
)
def test_wrong_arrays_are_one_line_and_no_pickle_is_opened(tmp_path: Path, change: dict, says: str) -> None:
    path = tmp_path / "tracks.npz"
    write_npz(path)
    with np.load(path) as arrays:
        kept = dict(arrays)
    np.savez(path, **(kept | change))
    with pytest.raises(DataError) as wrong:
        read_tracks(path)
    assert says in str(wrong.value)
    assert "\n" not in str(wrong.value)
