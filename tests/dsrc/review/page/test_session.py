"""A session: what one browser shows, and that no other moves it."""

import re
import threading
import time
from typing import Any

import numpy as np
import pytest
import viser

import dsrc.review.page.session as session_module
from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.commands import COMMANDS
from dsrc.review.page.panels import CONTROLS
from dsrc.review.page.panels.agents import AgentsPanel
from dsrc.review.page.panels.legend import LegendPanel
from dsrc.review.page.panels.selection import SelectionPanel
from dsrc.review.page.panels.timeline import TimelinePanel
from dsrc.review.page.scene import Clicked
from dsrc.review.page.server import start_server
from dsrc.review.page.session import Session
from dsrc.review.state import ReviewState
from dsrc.review.view import FrameView
from sensors.frame import Frame
from sim.errors import DataError
from sim.geometry import pose_angles
from tests.dsrc.review.conftest import FakeDetector, FakeDrive
from tests.dsrc.review.page.conftest import SocketBrowser
from tests.dsrc.review.page.session import counted, node, panel, wait_for


def handle(session: Session, field: str, label: str | None = None) -> Any:
    bound = [control for panel in session.panels for control in getattr(panel, "controls", ())]
    return next(b.handle for b in bound if b.control.field == field and label in (None, b.control.label))


def test_a_slider_moves_the_page(session: Session) -> None:
    handle(session, "frame").value = 5
    wait_for(lambda: session.state.frame == 5)
    assert session.wait_drawn().index == 5
    before = len(node(session, "/detections/tp/edges").points)
    handle(session, "threshold").value = 0.8
    wait_for(lambda: session.state.threshold == 0.8)
    assert session.wait_drawn().counts.fn > 1
    assert len(node(session, "/detections/tp/edges").points) < before


CHANGES = {
    "frame": 3, "speed": 2.0, "camera": "chase", "object_id": 1003, "corruption": "fog", "severity": 5,
    "family": "paper", "threshold": 0.7, "iou": 0.3, "ego_id": 1002, "cooperative": False, "color_by": "height",
    "point_size_m": 0.3, "max_points": 9000, "theme": "dark", "layers_off": frozenset({"bodies"}),
    "methods": ("detector",), "listed": "missed", "versus": "alone", "error_method": "detector", "error_class": "truck",
    "error_range": "30-50", "error_seen_by": "helper", "sensor": "vlp-16", "carrier": "pole",
    "corrupted_agents": "ego", "gallery": True, "follow": "selected", "rings": True, "cut": True,
}  # fmt: skip


@pytest.mark.parametrize("field", CHANGES)
def test_every_control_follows_the_state(session: Session, fake_fog: list[tuple[int, str, int]], field: str) -> None:
    session.update(**{field: CHANGES[field]})
    session.wait_drawn()
    bound = [control for panel in session.panels for control in getattr(panel, "controls", ())]
    for one in (one for one in bound if one.control.field == field):
        shown = {"camera": "Chase", "follow": "Selected", "object_id": "car 1003",
                 "speed": "2×", "ego_id": "vehicle 1002", "iou": "0.3",
                 "theme": "Dark", "versus": "ego alone", "error_seen_by": "helpers alone",
                 "methods": "detector", "corrupted_agents": "the ego",
                 "layers_off": one.control.label != "Bodies"}  # fmt: skip
        assert one.handle.value == shown.get(field, CHANGES[field])


def test_every_field_with_a_control_is_tried_above() -> None:
    elsewhere = {"drive", "boxes_by"}
    assert {control.field for control in CONTROLS if control.widget} - elsewhere == set(CHANGES)


def test_a_control_sets_the_state(session: Session, fake_fog: list[tuple[int, str, int]]) -> None:
    handle(session, "corruption").value = "fog"
    wait_for(lambda: session.state.corruption == "fog")
    session.wait_drawn()
    assert fake_fog == [(0, "fog", 3)]
    assert not handle(session, "severity").disabled
    handle(session, "layers_off", "Bodies").value = False
    wait_for(lambda: session.state.layers_off == {"bodies"})
    session.wait_drawn()
    assert not node(session, "/bodies").visible


def test_an_agents_switch_hides_its_points(session: Session) -> None:
    panel(session, AgentsPanel).switches[1002].handle.value = False
    wait_for(lambda: session.state.hidden == {1002})
    session.wait_drawn()
    assert not node(session, "/agents/vehicle_1002/lidar/points").visible


def test_another_ego_is_selected_by_name(session: Session, detector: FakeDetector) -> None:
    assert handle(session, "ego_id").value == "vehicle 1000"
    handle(session, "ego_id").value = "vehicle 1002"
    wait_for(lambda: session.state.ego_id == 1002)
    assert session.wait_drawn().ego.agent_id == 1002
    assert detector.samples[-1].agent_ids[0] == 1002
    assert node(session, "/agents/ego_vehicle_1000").visible is False
    assert node(session, "/agents/ego_vehicle_1002/lidar/points").visible


def test_the_report_counts_what_is_drawn(session: Session) -> None:
    counts = session.view.counts
    content = panel(session, LegendPanel).text.content
    assert counted(content) == {"true": counts.tp, "false": counts.fp, "missed": counts.fn, "other": 1}
    row = re.search(r"this frame((?:</td><td[^>]*>\d+){3})", content)
    assert re.findall(r">(\d+)", row[1]) == [str(counts.tp), str(counts.fp), str(counts.fn)]


def open_controls(session: Session) -> list[str]:
    """Labels of what can be set or pressed without opening a folder."""

    def is_open(container: str) -> bool:
        folder = session.gui._container_handle_from_uuid[container]
        if not isinstance(folder, viser.GuiFolderHandle):
            return True
        return folder.visible and folder.expand_by_default and is_open(folder._impl.parent_container_id)

    handles = session.gui._gui_input_handle_from_uuid.values()
    shown = [one for one in handles if one.visible and is_open(one._impl.parent_container_id)]
    return [one.label for one in shown]


def test_the_first_screen_has_twelve_controls_at_most(session: Session) -> None:
    labels = open_controls(session)
    assert {"Play", "Step", "Frame", "Object", "Score ≥", "IoU ≥"} <= set(labels)
    assert len(labels) <= 12, labels


def test_steps_stop_at_the_ends(session: Session) -> None:
    session.step(-1)
    assert session.state.frame == 0
    session.step(100)
    assert session.state.frame == 11


def test_playing_goes_around_until_it_is_paused(session: Session) -> None:
    session.update(frame=9, speed=4.0)
    session.toggle_play()
    wait_for(lambda: session.view.index in (0, 1, 2))
    session.toggle_play()
    session.wait_drawn()
    stopped = session.state.frame
    time.sleep(0.15)
    assert session.state.frame == stopped
    wait_for(lambda: panel(session, TimelinePanel).play.label == "Play")


def test_the_frames_that_come_next_are_read_ahead(
    session: Session, drive: FakeDrive, fake_fog: list[tuple[int, str, int]]
) -> None:
    wait_for(lambda: 1 in drive.reads)
    session.update(frame=6, corruption="fog", speed=0.25)
    session.wait_drawn()
    wait_for(lambda: {5, 7} <= set(drive.reads))
    assert [index for index, *_ in fake_fog] == [6], "corrupting takes long, and nobody may come here"
    session.toggle_play()
    wait_for(lambda: {10, 11} <= {index for index, *_ in fake_fog})
    session.toggle_play()


def test_nothing_plays_without_a_browser(app: ReviewApp, browser: SocketBrowser) -> None:
    session = browser.session
    session.toggle_play()
    browser.close()
    wait_for(lambda: not app.sessions)
    stopped = session.state.frame
    time.sleep(0.3)
    assert session.state.frame == stopped and not session._thread.is_alive()


def test_the_latest_state_wins(session: Session, model: ReviewModel, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, gate = [], threading.Event()
    view = model.view

    def slow_view(state: ReviewState) -> FrameView:
        drawn.append(state.frame)
        gate.wait(5.0)
        return view(state)

    monkeypatch.setattr(model, "view", slow_view)
    session.update(frame=1)
    wait_for(lambda: drawn)
    for frame in range(2, 12):
        session.update(frame=frame)
    gate.set()
    assert session.wait_drawn().index == 11
    assert drawn == [1, 11]


@pytest.mark.parametrize("error", [DataError("street/1000/000004.pcd: cut short"), KeyError("yaw")])
def test_what_cannot_be_drawn_is_told_and_the_next_frame_is_drawn(
    session: Session, drive: FakeDrive, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    read = type(drive).read

    def broken(self: FakeDrive, i: int) -> Frame:
        if i == 4:
            raise error
        return read(self, i)

    monkeypatch.setattr(type(drive), "read", broken)
    session.update(frame=4)
    session.wait_drawn()
    assert session._notice.visible and str(error.args[0])[:8].split("/")[0] in session._notice.content
    session.update(frame=6)
    assert session.wait_drawn().index == 6 and not session._notice.visible


def test_the_first_frame_is_drawn_before_its_detections_are_computed(
    app: ReviewApp, detector: FakeDetector, monkeypatch: pytest.MonkeyPatch, connect_browser: type[SocketBrowser]
) -> None:
    detect, gate = detector.detect, threading.Event()
    monkeypatch.setattr(detector, "detect", lambda sample: gate.wait(10.0) and detect(sample))
    session = connect_browser(app).session
    wait_for(lambda: node(session, "/agents/ego_vehicle_1000/lidar/points") is not None)
    wait_for(lambda: node(session, "/truth/detected/edges") is not None)
    assert session.view is None and session.address.link == ""
    assert node(session, "/agents/vehicle_1002/lidar/points") is None
    gate.set()
    assert session.wait_drawn().counts is not None
    assert node(session, "/agents/vehicle_1002/lidar/points").visible
    wait_for(lambda: session.address.link)


def test_a_broken_first_frame_blocks_nothing_else(
    model: ReviewModel, drive: FakeDrive, monkeypatch: pytest.MonkeyPatch, connect_browser: type[SocketBrowser]
) -> None:
    read = type(drive).read

    def broken(self: FakeDrive, i: int) -> Frame:
        if i == 0:
            raise DataError("street/1000/000000.pcd: cut short")
        return read(self, i)

    monkeypatch.setattr(type(drive), "read", broken)
    app = ReviewApp(model, start_server())
    try:
        session = connect_browser(app).session
        wait_for(lambda: "cut short" in session._notice.content)
        session.step(1)
        assert session.wait_drawn().index == 1
    finally:
        app.close()


def test_another_drive_starts_at_its_first_frame(
    detector: FakeDetector, drive: FakeDrive, connect_browser: type[SocketBrowser]
) -> None:
    other = type(drive)(frames=(3, 4))
    app = ReviewApp(ReviewModel([drive, other], detector), start_server(), ReviewState(frame=7))
    try:
        session = connect_browser(app).session
        session.wait_drawn()
        session.update(drive=1)
        assert session.wait_drawn().index == 3
        wait_for(lambda: handle(session, "frame").max == 1)
        assert [root.visible for root in session.stage.roots] == [False, True]
        assert node(session, "/agents/vehicle_1002/lidar/points") is None
    finally:
        app.close()


def test_two_browsers_do_not_move_each_other(
    app: ReviewApp, browser: SocketBrowser, connect_browser: type[SocketBrowser]
) -> None:
    first, second = browser.session, connect_browser(app).session
    second.wait_drawn()
    place = np.array(first.client.camera.position)
    second.update(frame=5, camera="bev", object_id=1003)
    assert second.wait_drawn().index == 5
    assert first.state == ReviewState() and first.wait_drawn().index == 0
    np.testing.assert_array_equal(first.client.camera.position, place)
    assert not np.allclose(second.client.camera.position, place)


def ego_in_scene(session: Session) -> tuple[np.ndarray, np.ndarray]:
    root = session.stage.roots[0]
    place = session.view.ego.review_from_body
    from viser.transforms import SO3

    turn = SO3(np.array(root.wxyz)).as_matrix()
    return turn @ place[:3, 3] + np.array(root.position), turn @ place[:3, :3]


def test_a_chasing_camera_stays_behind_the_ego(session: Session) -> None:
    session.place_camera("chase")
    session.wait_drawn()
    for frame in (0, 3, 11):
        session.update(frame=frame)
        session.wait_drawn()
        place, turn = ego_in_scene(session)
        np.testing.assert_allclose(place, 0.0, atol=1e-6)
        assert pose_angles(np.block([[turn, place[:, None]], [0, 0, 0, 1]]))[0] == pytest.approx(0.0)
    np.testing.assert_allclose(session.client.camera.position, [-34.0, 0.0, 21.0], atol=1e-6)


def test_a_late_pose_of_the_browser_keeps_its_offset_from_the_ego(browser: SocketBrowser) -> None:
    session = browser.session
    session.place_camera("chase")
    session.wait_drawn()
    for frame in range(12):
        session.update(frame=frame)
        browser.look_from((-20.0, 5.0, 10.0), (0.0, 0.0, 0.0))
        session.wait_drawn()
    wait_for(lambda: np.allclose(session.client.camera.position, [-20.0, 5.0, 10.0]))
    np.testing.assert_allclose(ego_in_scene(session)[0], 0.0, atol=1e-6)


def test_a_camera_set_free_keeps_its_picture(session: Session) -> None:
    session.update(frame=6)
    session.wait_drawn()
    session.place_camera("chase")
    session.wait_drawn()
    session.update(camera="free")
    session.wait_drawn()
    ego = session.view.ego.review_from_body
    np.testing.assert_allclose(session.client.camera.position, ego[:3, 3] + [-34.0, 0.0, 21.0], atol=1e-6)
    np.testing.assert_allclose(session.stage.roots[0].position, 0.0, atol=1e-9)


def test_the_camera_flies_to_the_selected_box(session: Session) -> None:
    session._select(Clicked(object_id=1003))
    session.wait_drawn()
    {command.label: command for command in COMMANDS}["Camera: to the selected box"].run(session)
    session.wait_drawn()
    target = session.view.selected
    np.testing.assert_allclose(session.client.camera.look_at, target, atol=1e-6)
    assert np.linalg.norm(session.client.camera.position - target) == pytest.approx(24.0)


def test_keys_are_unique_and_leave_the_cameras_keys_alone() -> None:
    keys = [(command.key.upper(), command.shift) for command in COMMANDS]
    assert len(set(keys)) == len(keys)
    assert not {key for key, _ in keys} & set("WASDQE")


def test_commands_change_the_page(session: Session, fake_fog: list[tuple[int, str, int]]) -> None:
    run = {command.label: command.run for command in COMMANDS}
    run["Last frame"](session)
    assert session.state.frame == 11
    run["Clean or corrupted"](session)
    assert session.state.corruption != "clean"
    run["Clean or corrupted"](session)
    assert session.state.corruption == "clean"
    run["Points of agent 2 alone"](session)
    assert session.state.hidden == {1000, -1}
    run["Points of all agents"](session)
    assert session.state.hidden == frozenset()
    run["Colour by: next"](session)
    assert session.state.color_by == "agent"
    run["Cooperative or alone"](session)
    assert not session.state.cooperative
    for label in ("Camera: chase the ego", "Camera: bird's eye", "Camera: reset"):
        run[label](session)
        session.wait_drawn()
    assert session.state.camera == "free"


def test_an_object_is_selected_in_the_list_or_by_a_click(session: Session) -> None:
    card = panel(session, SelectionPanel).card
    handle(session, "object_id").value = "car 1003"
    wait_for(lambda: session.state.object_id == 1003)
    details = session.wait_drawn().details
    assert details.object_id == 1003
    wait_for(lambda: "<b>car 1003</b>" in card.content)
    assert f"score {details.score:.2f}, IoU {details.iou:.2f}" in card.content and details.verdict == "found"
    session._select(Clicked(object_id=1004))
    assert session.wait_drawn().details.object_id == 1004
    wait_for(lambda: handle(session, "object_id").value == "car 1004")
    session.step(1)
    assert session.wait_drawn().details.object_id == 1004
    handle(session, "object_id").value = "none"
    wait_for(lambda: session.state.object_id is None)
    assert session.wait_drawn().details is None


def test_a_clicked_detection_opens_its_card(session: Session) -> None:
    view = session.view
    ghost = int(view.ranks["detections/fp"][0])
    session._select(session.stage.writer._clickable["detections/fp/faces"][0])
    details = session.wait_drawn().details
    assert (details.rank, details.verdict, details.object_id) == (ghost, "false", None)
    assert details.score == pytest.approx(0.4)
    wait_for(lambda: "<b>false</b>" in panel(session, SelectionPanel).card.content)
    session.step(1)
    assert session.wait_drawn().details is None, "a place in another list of scores is another detection"


def test_points_before_and_after_a_corruption_are_told_apart(
    session: Session, fake_fog: list[tuple[int, str, int]]
) -> None:
    session._select(Clicked(object_id=1003))
    session.update(corruption="fog")
    rows = session.wait_drawn().details.visibility
    assert all(row.points_left == pytest.approx(row.points / 2, abs=1) for row in rows)
    wait_for(lambda: f"{rows[0].points} → {rows[0].points_left}" in panel(session, SelectionPanel).card.content)


def test_while_frames_change_fewer_points_are_sent_and_all_of_them_once_the_view_rests(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session_module, "MOVING_POINTS", 300)
    session.update(frame=1)
    moving = session.wait_drawn(rested=False)
    assert 0 < sum(len(agent.points) for agent in moving.agents) <= 300
    rested = session.wait_drawn()
    assert rested.index == moving.index == 1
    assert all(len(agent.points) == agent.total for agent in rested.agents)
    session.update(threshold=0.9)
    assert all(len(agent.points) == agent.total for agent in session.wait_drawn(rested=False).agents)


def test_a_view_whose_rings_leave_fewer_points_than_it_could_draw_comes_to_rest(session: Session) -> None:
    session.update(frame=1, max_points=900)
    view = session.wait_drawn()
    assert all(0 < len(agent.points) < 900 < agent.total for agent in view.agents)
