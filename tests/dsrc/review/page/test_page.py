"""The scene that is written, and the page as it is served."""

import logging
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import dsrc
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.ops.detections import Detections
from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp, serve
from dsrc.review.page.scene import STYLES, SceneWriter
from dsrc.review.page.server import address, start_server, stop_server
from dsrc.review.palette import LOOKS
from dsrc.review.state import SHOWN_LAYERS, ColorBy, ReviewState
from dsrc.review.view import FALSE_NEGATIVES, SELECTED, UNJUDGED
from sensors.frame import Frame
from sensors.sweep import SCATTERED
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError
from tests.dsrc.review.conftest import FakeDetector, FakeDrive
from tests.dsrc.review.page.conftest import SocketBrowser


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = start_server()
    yield server
    stop_server(server)


def node(server: viser.ViserServer, name: str) -> Any:
    return server.scene.get_handle_by_name(name)


def test_a_frame_becomes_named_nodes_with_points_in_the_sensor_frame(
    server: viser.ViserServer, model: ReviewModel
) -> None:
    view = model.view(ReviewState())
    SceneWriter(server.scene).write(view)
    cloud = node(server, "/agents/ego_vehicle_1000/lidar/points")
    np.testing.assert_array_equal(cloud.points, view.agents[0].points.astype(np.float16))
    np.testing.assert_allclose(
        node(server, "/agents/vehicle_1002/lidar").position, view.agents[1].review_from_lidar[:3, 3]
    )
    assert node(server, "/agents/roadside_unit_1/label").text == "roadside unit 1"
    assert len(node(server, "/detections/tp/edges").points) == 13 * view.counts.tp
    assert len(node(server, "/bodies/car").batched_positions) == len(view.truth)


def test_the_points_of_the_next_frame_replace_those_of_the_last(server: viser.ViserServer, model: ReviewModel) -> None:
    writer = SceneWriter(server.scene)
    for row in (0, 1):
        view = model.view(ReviewState(frame=row))
        writer.write(view)
    name = "/agents/ego_vehicle_1000/lidar/points"
    buffered = server._websock_server._broadcast_buffer.message_from_id.values()
    updates = [one.updates for one in buffered if getattr(one, "name", "") == name and hasattr(one, "updates")]
    sent = {key: value for update in updates for key, value in update.items()}
    np.testing.assert_array_equal(sent["points"], view.agents[0].points.astype(np.float16), strict=True)
    np.testing.assert_array_equal(sent["colors"], view.agents[0].colors, strict=True)


@pytest.mark.parametrize("color_by", ["verdict", "agent", "fate", "height"])
def test_made_points_are_thin_where_colour_is_of_boxes_or_agents(
    server: viser.ViserServer, model: ReviewModel, color_by: ColorBy
) -> None:
    writer, clouds = SceneWriter(server.scene), "/agents/ego_vehicle_1000/lidar"
    view = model.view(ReviewState(corruption="snow", color_by=color_by))
    writer.write(view)
    points, made = (node(server, f"{clouds}/{name}") for name in ("points", "made"))
    total, snow = view.agents[0].total, view.agents[0].fates[SCATTERED]
    if color_by in ("verdict", "agent"):
        assert len(points.points) == total - snow and len(made.points) == snow > 0
        assert made.visible and made.point_size < 0.5 * points.point_size
        writer.write(model.view(ReviewState(corruption="snow", color_by="fate")))
        assert not made.visible
    else:
        assert made is None and len(points.points) == total


def test_the_selected_box_is_a_frame_around_its_verdict_on_the_same_ground(
    server: viser.ViserServer, model: ReviewModel
) -> None:
    writer = SceneWriter(server.scene)
    view = model.view(ReviewState(object_id=1003))
    writer.write(view)
    box, drawn = view.layers[SELECTED], node(server, "/selected/box/edges")
    low, high = (of(drawn.points.reshape(-1, 3)[:-2], axis=0) for of in (np.min, np.max))
    corners = box.corners()[0]
    assert (low[:2] < corners.min(axis=0)[:2] - 0.1).all() and (high > corners.max(axis=0) + 0.1).all()
    assert low[2] == pytest.approx(corners[:, 2].min(), abs=1e-3)
    assert drawn.thickness > STYLES[FALSE_NEGATIVES].thickness


def test_a_layer_that_gets_empty_is_hidden_and_comes_back(server: viser.ViserServer, model: ReviewModel) -> None:
    writer = SceneWriter(server.scene)
    for threshold, shown in ((0.0, True), (1.0, False), (0.0, True)):
        writer.write(model.view(ReviewState(threshold=threshold)))
        assert node(server, "/detections/fp/edges").visible is shown
        assert node(server, "/detections/fp/faces").visible is shown


def test_layers_can_be_switched_off(server: viser.ViserServer, model: ReviewModel) -> None:
    writer = SceneWriter(server.scene)
    writer.write(model.view(ReviewState(layers_off=frozenset(SHOWN_LAYERS))))
    writer.place_world([], "light")
    names = ("/truth/detected", "/detections/tp", "/bodies", "/world", "/links", "/agents/vehicle_1002/label")
    assert [node(server, name).visible for name in names] == [False] * 6
    assert node(server, "/agents/vehicle_1002/lidar/points").visible


def test_clearing_leaves_nothing_of_a_drive(
    server: viser.ViserServer, model: ReviewModel, recwarn: pytest.WarningsRecorder
) -> None:
    writer = SceneWriter(server.scene)
    writer.write(model.view(ReviewState()))
    writer.clear()
    assert node(server, "/agents/vehicle_1002/lidar/points") is None
    writer.write(model.view(ReviewState(frame=1)))
    assert node(server, "/agents/vehicle_1002/lidar/points") is not None
    assert not recwarn.list


def test_an_agent_that_leaves_takes_its_points_with_it(server: viser.ViserServer, model: ReviewModel) -> None:
    writer = SceneWriter(server.scene)
    view = model.view(ReviewState())
    writer.write(view)
    writer.write(replace(view, agents=view.agents[:2]))
    assert node(server, "/agents/roadside_unit_1").visible is False
    assert node(server, "/agents/vehicle_1002").visible is True
    writer.write(view)
    assert node(server, "/agents/roadside_unit_1").visible is True


def test_without_labels_nothing_is_judged(
    drive: FakeDrive, detector: FakeDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = type(drive).read
    empty = Boxes.zeros()

    def unlabelled(self: FakeDrive, i: int) -> Frame:
        frame = read(self, i)
        none = np.zeros((0, 2))
        return replace(
            frame,
            truth=empty,
            velocity=none,
            acceleration=none,
            tilt=none,
            signals=np.zeros(0, np.int32),
            lane=(),
            points_on=frame.points_on[:, :0],
            visible_fraction=frame.visible_fraction[:, :0],
        )

    monkeypatch.setattr(type(drive), "read", unlabelled)
    monkeypatch.setattr(type(detector), "detect", lambda self, sample: ghosts())
    model = ReviewModel([drive], detector)
    view = model.view(ReviewState())
    assert view.counts is None
    assert len(view.layers[UNJUDGED]) == 2 and not len(view.layers["detections/fp"])
    assert not view.labelled


def ghosts() -> Detections:
    from dsrc.ops.detections import Detections

    boxes = Boxes.from_array([[10.0, -25.0, -1.0, 4.0, 2.0, 1.5, 0.3], [20.0, 0.0, -1.0, 4.0, 2.0, 1.5, 0.0]])
    return Detections(boxes, np.array([0.9, 0.5], np.float32))


def test_the_page_listens_on_the_loopback_only_and_answers(app: ReviewApp) -> None:
    assert app.url.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(app.url, timeout=10) as answer:
        assert answer.status == 200
        assert b"review-link" in answer.read()


@pytest.mark.parametrize(
    "headers", [{"Origin": "http://evil.example"}, {"Origin": "http://127.0.0.1:1"}, {"Origin": "null"}]
)
def test_a_page_of_another_origin_gets_neither_the_scene_nor_the_page(app: ReviewApp, headers: dict[str, str]) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        connect(app.url.replace("http", "ws"), additional_headers=headers)
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(urllib.request.Request(app.url, headers=headers), timeout=10)


def test_a_foreign_name_that_leads_to_the_loopback_gets_nothing(app: ReviewApp) -> None:
    port = app.url.rsplit(":", 1)[1]
    named = {"Host": f"evil.example:{port}", "Origin": f"http://evil.example:{port}"}
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(urllib.request.Request(app.url, headers=named), timeout=10)
    local = urllib.request.Request(app.url, headers={"Host": "localhost:1", "Origin": "http://localhost:1"})
    # A forwarded port has another number on the other side.
    with urllib.request.urlopen(local, timeout=10) as answer:
        assert answer.status == 200


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "hub.example", "Origin": "https://hub.example"}, 200),  # code-server and tunnels keep the name
        ({"Origin": "https://hub.example:8443"}, 200),  # jupyter-server-proxy puts that of the server in its place
        ({"Host": "hub.example"}, 200),
        ({"Host": "hub.example", "Origin": "https://evil.example"}, 403),
        ({"Host": "evil.example", "Origin": "https://hub.example"}, 403),
        ({"Origin": "https://hub.example.evil"}, 403),
    ],
)
def test_an_allowed_host_shows_the_page_and_no_other_does(headers: dict[str, str], status: int) -> None:
    server = start_server(allow_origin=["https://hub.example/user/me"])
    try:
        request = urllib.request.Request(address(server), headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                found = answer.status
        except urllib.error.HTTPError as error:
            found = error.code
        assert found == status
        assert server.get_host() == "127.0.0.1"
    finally:
        stop_server(server)


@pytest.mark.parametrize("host", ["*", "", "https://", "*.example"])
def test_an_origin_that_is_no_host_is_refused(host: str) -> None:
    with pytest.raises(SettingsError, match="allow-origin: expected a host"):
        start_server(allow_origin=[host])


def test_a_drive_is_a_frame_of_a_notebook(tmp_path: Path, frame: Frame) -> None:
    write_frame(tmp_path / "drive", frame)
    page = dsrc.view(dsrc.open_drive(tmp_path / "drive"))
    try:
        assert page._repr_html_().startswith(f'<iframe src="{page.url}"')
        with urllib.request.urlopen(page.url, timeout=10) as answer:
            assert answer.status == 200
    finally:
        page.close()


def test_serve_opens_a_folder_of_drives(tmp_path: Path, frame: Frame, connect_browser: type[SocketBrowser]) -> None:
    for index in (0, 1):
        write_frame(tmp_path / "drive", replace(frame, index=index))
    announced = []
    app = serve(tmp_path, frame=1, block=False, announce=announced.append)
    try:
        assert announced == [app.url]
        view = connect_browser(app).session.wait_drawn()
        assert (view.drive, view.index) == ("drive", 1)
    finally:
        app.close()


def test_bad_input_fails_before_a_server_starts(tmp_path: Path, frame: Frame, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dsrc.review.page.app.start_server", lambda *_: pytest.fail("a server was started"))
    with pytest.raises(SettingsError, match="unknown corruption 'clen'; did you mean 'clean'"):
        serve(tmp_path, corruption="clen", block=False)
    with pytest.raises(DataError):
        serve(tmp_path / "nowhere", block=False)
    write_frame(tmp_path / "drive", frame)
    with pytest.raises(SettingsError, match="frame: expected 0 to 0, found 3"):
        serve(tmp_path, frame=3, block=False)
    for pcd in (tmp_path / "drive").rglob("*.pcd"):
        pcd.write_bytes(pcd.read_bytes()[:60])
    with pytest.raises(DataError, match="pcd"):
        serve(tmp_path, block=False)


def test_a_drive_that_cannot_be_read_does_not_block_the_others(
    tmp_path: Path, frame: Frame, connect_browser: type[SocketBrowser]
) -> None:
    for name in ("a", "b"):
        write_frame(tmp_path / name, frame)
    for pcd in (tmp_path / "a").rglob("*.pcd"):
        pcd.write_bytes(pcd.read_bytes()[:60])
    app = serve(tmp_path, block=False)
    try:
        assert connect_browser(app).session.wait_drawn().drive == "b"
    finally:
        app.close()


def test_a_busy_port_is_one_line(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(SettingsError, match=rf"^view: port: expected a free port of 127.0.0.1, found {port}"):
            serve(tmp_path, port=port, block=False)
    with pytest.raises(SettingsError, match="expected 1 to 65535"):
        serve(tmp_path, port=70_000, block=False)
    with pytest.raises(SettingsError, match="host"):
        serve(tmp_path, host="256.1.1.1", block=False)


def test_the_light_is_drawn_once_for_all_and_every_browser_has_the_world_in_its_theme(
    app: ReviewApp, browser: SocketBrowser, connect_browser: type[SocketBrowser]
) -> None:
    session = connect_browser(app).session
    session.update(theme="dark")
    session.wait_drawn()
    assert node(app.server, "/light/ambient") is not None and len(app.sessions) == 2
    grids = [node(one.client, "/drive0/world/grid") for one in (browser.session, session)]
    assert [grid.cell_color for grid in grids] == [LOOKS["light"].grid[0], LOOKS["dark"].grid[0]]


def test_a_connection_that_a_browser_opens_ahead_and_drops_is_not_told(
    app: ReviewApp, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.ERROR, logger="websockets.server")
    with socket.create_connection(("127.0.0.1", int(app.url.rsplit(":", 1)[1]))):
        pass
    with urllib.request.urlopen(app.url, timeout=10) as answer:
        assert answer.status == 200
    time.sleep(0.5)
    assert not caplog.messages


def test_a_page_without_a_detector_imports_nothing_heavy_before_it_is_served() -> None:
    heavy = "{'torch', 'trimesh', 'scipy.optimize', 'scipy.ndimage'}"
    code = f"import sys, dsrc.review.page.app; print(*{heavy} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "", found.stdout
