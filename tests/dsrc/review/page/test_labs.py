"""The labs of the page: what their widgets set, draw and count."""

import re
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from viser.transforms import SO3

from dsrc.data.drives import open_drive
from dsrc.review.labs.casting import DriveWorld
from dsrc.review.labs.placement import Cast, Placement
from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.commands import toggle_corruption
from dsrc.review.page.link import read_link, write_link
from dsrc.review.page.panels.labs.corruption import CorruptionLabPanel
from dsrc.review.page.panels.labs.sensor import SensorLabPanel
from dsrc.review.page.panels.legend import LegendPanel
from dsrc.review.page.server import start_server
from dsrc.review.page.session import Session
from dsrc.review.state import ReviewState
from sensors.spec import LidarSpec
from tests.dsrc.review.labs.drive import small_drive
from tests.dsrc.review.page.conftest import SocketBrowser
from tests.dsrc.review.page.session import node, panel, wait_for


def counted(lab: CorruptionLabPanel) -> list[list[str]]:
    """Cells of each row of the table of points."""
    rows = re.findall("<tr>(.*?)</tr>", lab.effects.content.replace("\u202f", ""))
    return [re.findall("<t[hd][^>]*>(.*?)</t[hd]>", row) for row in rows]


@pytest.fixture
def lab(session: Session) -> CorruptionLabPanel:
    return panel(session, CorruptionLabPanel)


def test_a_corruption_brings_its_parameters(session: Session, lab: CorruptionLabPanel) -> None:
    assert not lab.parameters and not lab.effects.visible
    session.update(corruption="point_dropping", severity=4)
    session.wait_drawn()
    wait_for(lambda: list(lab.parameters) == ["share", "patches", "how", "patch_share"])
    assert lab.parameters["share"].handle.value == pytest.approx(0.24)
    session.update(corruption="clean")
    session.wait_drawn()
    wait_for(lambda: not lab.parameters)


def test_a_slider_changes_the_sweeps_and_the_severity_sets_it_back(session: Session, lab: CorruptionLabPanel) -> None:
    session.update(corruption="point_dropping")
    session.wait_drawn()
    slider = lab.parameters["share"].handle
    slider.value = 0.6
    wait_for(lambda: session.state.parameters == (("share", 0.6),))
    few = session.wait_drawn().agents[0].total
    assert lab.parameters["share"].handle is slider, "a slider that is moved stays the same"
    session.update(severity=1)
    assert session.wait_drawn().agents[0].total > few and session.state.parameters == ()
    wait_for(lambda: slider.value == pytest.approx(0.06))


def test_choices_and_whole_numbers_keep_their_type(session: Session, lab: CorruptionLabPanel) -> None:
    session.update(corruption="point_dropping")
    session.wait_drawn()
    lab.parameters["how"].handle.value = "patches"
    wait_for(lambda: dict(session.state.parameters).get("how") == "patches")
    lab.parameters["patches"].handle.value = 9
    wait_for(lambda: dict(session.state.parameters).get("patches") == 9)
    assert type(dict(session.state.parameters)["patches"]) is int
    session.wait_drawn()
    assert lab.reset.visible
    lab.reset.value = True
    wait_for(lambda: session.state.parameters == ())


def test_lost_points_are_drawn_and_all_are_counted(session: Session, lab: CorruptionLabPanel) -> None:
    whole = session.view.agents[0]
    session.update(corruption="point_dropping", color_by="fate")
    agent = session.wait_drawn().agents[0]
    assert agent.total + agent.lost == whole.total and len(agent.lost_points) == agent.lost > 0
    drawn = node(session, "/agents/ego_vehicle_1000/lidar/lost").points
    np.testing.assert_allclose(drawn, agent.lost_points, atol=0.05)
    ours = {tuple(point) for point in whole.points.tolist()} - {tuple(point) for point in agent.points.tolist()}
    assert ours == {tuple(point) for point in agent.lost_points.tolist()}
    wait_for(lambda: ["ego", f"{agent.total}", "0", "0", f"{agent.lost}"] in counted(lab))
    session.update(color_by="agent")
    session.wait_drawn()
    assert not node(session, "/agents/ego_vehicle_1000/lidar/lost").visible


def test_moved_points_are_counted_as_such(session: Session, lab: CorruptionLabPanel) -> None:
    session.update(corruption="noise", parameters=(("size_m", 0.2),))
    agent = session.wait_drawn().agents[0]
    wait_for(lambda: ["ego", f"{agent.total}", "0", f"{agent.total}", "0"] in counted(lab))
    assert counted(lab)[0] == ["", "points", "added", "moved", "lost"]


def test_colours_that_are_a_scale_have_a_bar(session: Session) -> None:
    legend = panel(session, LegendPanel)
    for color_by, ends in (("height", ("-0.5 m", "8 m")), ("intensity", ("0", "1"))):
        session.update(color_by=color_by)
        session.wait_drawn()
        wait_for(lambda ends=ends: all(f"<span>{end}</span>" in legend.text.content for end in ends))
        assert "linear-gradient" in legend.text.content
    session.update(color_by="agent")
    session.wait_drawn()
    wait_for(lambda: "linear-gradient" not in legend.text.content)


def test_the_ego_is_named_and_others_when_they_are_selected(session: Session) -> None:
    names = {"ego": "/agents/ego_vehicle_1000/label", "other": "/agents/vehicle_1002/label"}
    assert node(session, names["ego"]).visible and not node(session, names["other"]).visible
    session.update(object_id=1002)
    session.wait_drawn()
    assert node(session, names["other"]).visible


def test_clean_and_back_keeps_the_parameters(session: Session) -> None:
    session.update(corruption="noise", severity=2, parameters=(("size_m", 0.2),))
    toggle_corruption(session)
    assert (session.state.corruption, session.state.parameters) == ("clean", ())
    toggle_corruption(session)
    assert (session.state.corruption, session.state.parameters) == ("noise", (("size_m", 0.2),))


def test_a_link_with_parameters_that_do_not_exist_is_refused(model: ReviewModel) -> None:
    state, _, complaints = read_link("corruption=noise&parameters=loud:3", model, ReviewState())
    assert state == ReviewState(corruption="noise") and "expected size_m" in complaints[0]
    state, _, complaints = read_link("corruption=fog&parameters=extinction:-3", model, ReviewState())
    assert state.parameters == () and "extinction: expected 0 to" in complaints[0]
    tuned = ReviewState(corruption="fog", parameters=(("extinction", 0.123),))
    assert write_link(model, tuned, None) == "corruption=fog&parameters=extinction:0.123"


def test_the_ap_of_the_drive_is_filled_in_clean_and_corrupted(session: Session, lab: CorruptionLabPanel) -> None:
    session.update(corruption="point_dropping", parameters=(("share", 0.6),))
    session.wait_drawn()
    wait_for(lambda: "| 1 of 12 |" in lab.scores.content and lab.detect.visible)
    lab._detect(None)
    wait_for(lambda: lab.scores.content.count("| 12 of 12 |") == 2)
    clean, corrupted = (line.split("|")[2:5] for line in lab.scores.content.splitlines()[2:])
    expected = session.report(ReviewState()).curves["detector", 0.5].ap
    assert clean[1].strip() == f"{100 * expected:.1f}" and corrupted[1].strip() != "–"
    wait_for(lambda: not lab.detect.visible)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ReviewApp]:
    """Page of a simulated drive, which has a world."""
    drive = open_drive(small_drive(tmp_path_factory.mktemp("data")))
    app = ReviewApp(ReviewModel([drive]), start_server())
    yield app
    app.close()


@pytest.fixture
def placed(recorded: ReviewApp, connect_browser: type[SocketBrowser]) -> Iterator[Session]:
    browser = connect_browser(recorded)
    browser.session.wait_drawn()
    session = browser.session
    yield session
    session.update(sensor="")
    session.wait_drawn()
    wait_for(lambda: not panel(session, SensorLabPanel)._latest.running)
    browser.close()
    wait_for(lambda: not recorded.sessions)


def cast_of(session: Session) -> Cast:
    sensors = panel(session, SensorLabPanel)
    wait_for(lambda: sensors.cast is not None)
    return sensors.cast


def cast_after(session: Session, **changes: Any) -> Cast:
    """Cast of a change of the state."""
    before = panel(session, SensorLabPanel).cast
    session.update(**changes)
    session.wait_drawn()
    wait_for(lambda: panel(session, SensorLabPanel).cast not in (before, None))
    return cast_of(session)


def test_a_preset_on_the_ego_is_cast_and_counted(placed: Session) -> None:
    sensors = panel(placed, SensorLabPanel)
    made = cast_after(placed, sensor="vlp-16")
    assert made.rays == made.sweep.spec.rings * made.sweep.spec.columns
    text = sensors.text.content.replace("\u202f", "")
    assert (
        f"**{len(made.sweep)} points** of {made.rays} rays" in text and f"{made.rays * 10 / 1e6:.2f} M rays/s." in text
    )
    cloud = node(placed, "/lab/lidar/points")
    assert cloud.visible and len(cloud.points) == len(made.sweep) > 1000
    denser = cast_after(placed, sensor="opv2v-64")
    assert denser.rays > made.rays and sensors.text.visible
    placed.update(sensor="")
    placed.wait_drawn()
    wait_for(lambda: node(placed, "/lab/lidar/points") is None and node(placed, "/lab/gizmo") is None)
    assert not sensors.text.visible


def test_the_gizmo_moves_the_sensor(placed: Session) -> None:
    sensors = panel(placed, SensorLabPanel)
    cast_after(placed, sensor="vlp-16")
    ego = placed.view.ego.review_from_body
    wanted = ego[:3, 3] + ego[:3, :3] @ [1.0, 2.0, 4.0]
    target = SimpleNamespace(wxyz=SO3.from_matrix(ego[:3, :3]).wxyz, position=wanted)
    before = sensors.cast
    sensors._drag(SimpleNamespace(target=target, phase="end"))
    wait_for(lambda: sensors.cast not in (before, None))
    assert placed.state.placement == pytest.approx((1.0, 2.0, 4.0, 0.0, 0.0), abs=0.01)
    np.testing.assert_allclose(node(placed, "/lab/gizmo").position, wanted, atol=0.01)
    np.testing.assert_allclose(node(placed, "/lab/lidar").position, wanted, atol=0.01)
    assert sensors.position.value == pytest.approx((1.0, 2.0, 4.0), abs=0.01)


def test_numbers_move_the_sensor_and_the_usual_place_brings_it_back(placed: Session) -> None:
    sensors = panel(placed, SensorLabPanel)
    cast_after(placed, sensor="vlp-16", carrier="pole")
    sensors.position.value = (3.0, -2.0, 7.0)
    wait_for(lambda: placed.state.placement[:3] == (3.0, -2.0, 7.0))
    np.testing.assert_allclose(placed.wait_drawn() and node(placed, "/lab/gizmo").position, (3.0, -2.0, 7.0))
    placed.update(carrier="ego")
    assert placed.state.placement == ()


def test_the_newest_place_wins(placed: Session, monkeypatch: pytest.MonkeyPatch) -> None:

    gate, cast, places = threading.Event(), DriveWorld.cast, []

    def slow(self: DriveWorld, index: int, time_s: float, spec: LidarSpec, placement: Placement, carrier: int) -> Cast:
        places.append(placement.xyz_m[2])
        gate.wait(5.0)
        return cast(self, index, time_s, spec, placement, carrier)

    monkeypatch.setattr(DriveWorld, "cast", slow)
    placed.update(sensor="vlp-16", carrier="pole", placement=(0.0, 0.0, 3.0, 0.0, 0.0))
    wait_for(lambda: places == [3.0])
    for height in (4.0, 5.0, 6.0, 7.0):
        placed.update(placement=(0.0, 0.0, height, 0.0, 0.0))
        placed.wait_drawn()
    gate.set()
    wait_for(lambda: panel(placed, SensorLabPanel).cast is not None)
    assert places == [3.0, 7.0]
    np.testing.assert_allclose(node(placed, "/lab/lidar").position, (0.0, 0.0, 7.0))


def test_a_drive_without_a_world_says_so_in_a_line(session: Session) -> None:
    session.update(sensor="vlp-16")
    session.wait_drawn()
    text = panel(session, SensorLabPanel).text
    wait_for(lambda: "world.npz: expected the world and traffic of the drive, found none" in text.content)
    assert "\n" not in text.content and node(session, "/lab/lidar/points") is None


def test_a_placement_of_a_link_is_five_numbers_within_reach(model: ReviewModel) -> None:
    state, _, complaints = read_link("sensor=vlp-16&carrier=pole&placement=1,2,5,90,-10", model, ReviewState())
    assert (state.sensor, state.carrier, state.placement) == ("vlp-16", "pole", (1.0, 2.0, 5.0, 90.0, -10.0))
    assert not complaints
    for wrong in ("1,2", "1,2,nan,0,0", "1,2,3,0,100", "a,b,c,d,e"):
        state, _, complaints = read_link(f"placement={wrong}", model, ReviewState())
        assert state.placement == () and "five numbers" in complaints[0]
    assert "expected none, " in read_link("sensor=lidar9000", model, ReviewState())[2][0]
