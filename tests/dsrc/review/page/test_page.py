import socket
import threading
import time
import urllib.request
from dataclasses import replace

import numpy as np
import pytest

from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp, serve
from dsrc.review.page.commands import commands, next_error
from dsrc.review.page.scene import SceneWriter
from dsrc.review.page.server import start_server, stop_server
from dsrc.review.state import SHOWN_LAYERS, ReviewState
from sim.errors import DataError, SettingsError


@pytest.fixture
def server():
    server = start_server()
    yield server
    stop_server(server)


@pytest.fixture
def app(model):
    app = ReviewApp(model, start_server(), ReviewState())
    app.wait_drawn()
    yield app
    app.close()


def node(server, name):
    return server.scene.get_handle_by_name(name)


def wait_for(condition, timeout_s=10.0):
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


def test_a_frame_becomes_named_nodes_with_points_in_the_sensor_frame(server, model):
    view = model.view(ReviewState())
    SceneWriter(server).write(view)
    cloud = node(server, "/agents/ego_vehicle_1000/lidar/points")
    np.testing.assert_array_equal(cloud.points, view.agents[0].points.astype(np.float16))
    np.testing.assert_allclose(
        node(server, "/agents/vehicle_1002/lidar").position, view.agents[1].review_from_lidar[:3, 3]
    )
    assert node(server, "/agents/roadside_unit_1/label").text == "roadside unit 1"
    assert len(node(server, "/detections/tp/edges").points) == 13 * view.counts.tp
    assert len(node(server, "/bodies/car").batched_positions) == len(view.truth)


def test_a_layer_that_gets_empty_is_hidden_and_comes_back(server, model):
    writer = SceneWriter(server)
    for threshold, shown in ((0.0, True), (1.0, False), (0.0, True)):
        writer.write(model.view(ReviewState(threshold=threshold)))
        assert node(server, "/detections/fp/edges").visible is shown
        assert node(server, "/detections/fp/faces").visible is shown


def test_layers_can_be_switched_off(server, model):
    writer = SceneWriter(server)
    writer.place_static([])
    writer.write(model.view(ReviewState(layers_off=frozenset(SHOWN_LAYERS))))
    names = ("/truth/detected", "/detections/tp", "/bodies", "/world", "/links", "/agents/vehicle_1002/label")
    assert [node(server, name).visible for name in names] == [False] * 6
    assert node(server, "/agents/vehicle_1002/lidar/points").visible


def test_clearing_leaves_nothing_of_a_drive(server, model, recwarn):
    writer = SceneWriter(server)
    writer.place_static([])
    writer.write(model.view(ReviewState()))
    writer.clear()
    assert node(server, "/agents/vehicle_1002/lidar/points") is None
    writer.write(model.view(ReviewState(frame=1)))
    assert node(server, "/agents/vehicle_1002/lidar/points") is not None
    assert not recwarn.list


def test_the_page_listens_on_the_loopback_only_and_answers(app):
    assert app.url.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(app.url, timeout=10) as answer:
        assert answer.status == 200


def test_the_sliders_move_the_page(app):
    app._panels.frame.value = 5
    wait_for(lambda: app.state.frame == 5)
    assert app.wait_drawn().index == 5
    before = len(node(app.server, "/detections/tp/edges").points)
    app._panels.threshold.value = 0.8
    wait_for(lambda: app.state.threshold == 0.8)
    assert app.wait_drawn().counts.fn > 1
    assert len(node(app.server, "/detections/tp/edges").points) < before


def test_the_report_counts_what_is_drawn(app):
    counts = app.view.counts
    assert f"| this frame | {counts.tp} | {counts.fp} | {counts.fn} |" in app._panels.report.content


def test_a_dropdown_brings_a_corruption(app, fake_fog):
    app._panels.corruption.value = "fog"
    wait_for(lambda: app.state.corruption == "fog")
    app.wait_drawn()
    assert fake_fog == [(0, "fog", 3)]
    assert not app._panels.severity.disabled


def test_a_dropdown_changes_the_family_of_the_settings(app, fake_fog):
    app.update(corruption="fog")
    app.wait_drawn()
    app._panels.family.value = "paper"
    wait_for(lambda: app.state.family == "paper")
    app.wait_drawn()
    assert len(fake_fog) == 2
    assert not app._panels.family.disabled


def test_an_agents_box_hides_its_points(app):
    app._panels.agent_boxes[1002].value = False
    wait_for(lambda: app.state.hidden == {1002})
    app.wait_drawn()
    assert not node(app.server, "/agents/vehicle_1002/lidar/points").visible


def test_another_ego_is_selected_by_name(app, detector):
    assert app._panels.ego.value == "vehicle 1000"
    app._panels.ego.value = "vehicle 1002"
    wait_for(lambda: app.state.ego_id == 1002)
    assert app.wait_drawn().ego.agent_id == 1002
    assert detector.samples[-1].agent_ids[0] == 1002
    assert node(app.server, "/agents/ego_vehicle_1000/lidar/points") is None
    assert node(app.server, "/agents/ego_vehicle_1002/lidar/points").visible


def test_steps_stop_at_the_ends(app):
    app.step(-1)
    assert app.state.frame == 0
    app.step(100)
    assert app.state.frame == 11


def test_playing_goes_around_until_it_is_paused(app):
    app.update(frame=9)
    app.play(20.0)
    wait_for(lambda: app.view.index in (0, 1, 2))
    app.toggle_play()
    app.wait_drawn()
    time.sleep(0.1)
    stopped = app.state.frame
    time.sleep(0.15)
    assert app.state.frame == stopped and app._panels.play.label == "Play"


def test_the_latest_state_wins(model, monkeypatch):
    drawn, gate = [], threading.Event()
    view = model.view

    def slow_view(state):
        drawn.append(state.frame)
        gate.wait(5.0)
        return view(state)

    monkeypatch.setattr(model, "view", slow_view)
    app = ReviewApp(model, start_server())
    try:
        wait_for(lambda: drawn)
        for frame in range(1, 12):
            app.update(frame=frame)
        gate.set()
        assert app.wait_drawn().index == 11
        assert drawn == [0, 11]
    finally:
        gate.set()
        app.close()


def test_a_broken_frame_is_reported_on_the_page_and_the_next_is_drawn(app, drive, monkeypatch):
    read = type(drive).read

    def broken(self, i):
        if i == 4:
            raise DataError("street/1000/000004.pcd: cut short")
        return read(self, i)

    monkeypatch.setattr(type(drive), "read", broken)
    app.update(frame=4)
    app.wait_drawn()
    assert "cut short" in app._panels.notice.content and app._panels.notice.visible
    app.update(frame=6)
    assert app.wait_drawn().index == 6 and not app._panels.notice.visible


def test_another_drive_starts_at_its_first_frame(detector, drive):
    other = type(drive)(frames=(3, 4))
    app = ReviewApp(ReviewModel([drive, other], detector), start_server(), ReviewState(frame=7))
    try:
        app.wait_drawn()
        app.update(drive=1)
        assert app.wait_drawn().index == 3
        assert app._panels.frame.max == 1
    finally:
        app.close()


def test_keys_are_unique_and_leave_the_cameras_keys_alone(app):
    keys = [(command.key, command.shift) for command in commands(app)]
    assert len(set(keys)) == len(keys)
    assert not {key.upper() for key, _ in keys} & set("WASDQE")


def test_commands_change_the_page(app, fake_fog):
    by_label = {command.label: command.run for command in commands(app)}
    by_label["Last frame"]()
    assert app.state.frame == 11
    by_label["Clean or corrupted"]()
    assert app.state.corruption != "clean"
    by_label["Clean or corrupted"]()
    assert app.state.corruption == "clean"
    by_label["Points of agent 2 alone"]()
    assert app.state.hidden == {1000, -1}
    by_label["Points of all agents"]()
    assert app.state.hidden == frozenset()
    by_label["Next colour of the points"]()
    assert app.state.color_by == "intensity"
    for label in ("Camera: chase the ego", "Camera: bird's eye", "Camera: reset"):
        by_label[label]()
    app.wait_drawn()


def test_the_next_error_is_the_next_frame_with_an_fp_or_fn(app):
    next_error(app, 1)
    assert app.state.frame == 1
    next_error(app, -1)
    assert app.state.frame == 0


def test_serve_opens_a_folder_of_drives(tmp_path, frame):
    for index in (0, 1):
        write_frame(tmp_path / "drive", replace(frame, index=index))
    announced = []
    app = serve(tmp_path, block=False, announce=announced.append)
    try:
        assert announced == [app.url]
        assert app.wait_drawn().drive == "drive"
    finally:
        app.close()


def test_bad_input_fails_before_a_server_starts(tmp_path, monkeypatch):
    monkeypatch.setattr("dsrc.review.page.app.start_server", lambda *_: pytest.fail("a server was started"))
    with pytest.raises(SettingsError, match="unknown corruption 'clen'; did you mean 'clean'"):
        serve(tmp_path, corruption="clen", block=False)
    with pytest.raises(DataError):
        serve(tmp_path / "nowhere", block=False)


def test_a_busy_port_is_one_line(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(SettingsError, match=rf"^view: port: expected a free port of 127.0.0.1, found {port}"):
            serve(tmp_path, port=port, block=False)
    with pytest.raises(SettingsError, match="expected 1 to 65535"):
        serve(tmp_path, port=70_000, block=False)
    with pytest.raises(SettingsError, match="host"):
        start_server("256.1.1.1")


def test_an_object_is_selected_in_the_list_or_by_a_click(app):
    app._panels.object.value = "car 1003"
    view = app.wait_drawn()
    assert app.state.object_id == 1003 and view.details.object_id == 1003
    assert "**car 1003**" in app._panels.object_report.content
    app._writer._on_object(1004)
    assert app.wait_drawn().details.object_id == 1004
    assert app._panels.object.value == "car 1004"
    app.step(1)
    assert app.wait_drawn().details.object_id == 1004
    app._panels.object.value = "none"
    assert app.wait_drawn().details is None
