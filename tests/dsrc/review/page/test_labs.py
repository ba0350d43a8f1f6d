"""The labs of the page: what their widgets set, draw and count."""

import time

import numpy as np
import pytest

from dsrc.review.page.commands import toggle_corruption
from dsrc.review.page.link import read_link, write_link
from dsrc.review.page.panels.corruption_lab import CorruptionLabPanel
from dsrc.review.state import ReviewState


def wait_for(condition, timeout_s=10.0):
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


def panel(session, kind):
    return next(panel for panel in session.panels if isinstance(panel, kind))


def node(session, name):
    return session.client.scene.get_handle_by_name(f"/drive0{name}")


def counted(lab):
    return lab.effects.content.replace("\u2009", "")


@pytest.fixture
def lab(session):
    return panel(session, CorruptionLabPanel)


def test_a_corruption_brings_its_parameters(session, lab):
    assert not lab.parameters and not lab.effects.visible
    session.update(corruption="point_dropping", severity=4)
    session.wait_drawn()
    wait_for(lambda: list(lab.parameters) == ["share", "patches", "how", "patch_share"])
    assert lab.parameters["share"].handle.value == pytest.approx(0.24)
    session.update(corruption="clean")
    session.wait_drawn()
    wait_for(lambda: not lab.parameters)


def test_a_slider_changes_the_sweeps_and_the_severity_sets_it_back(session, lab):
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


def test_choices_and_whole_numbers_keep_their_type(session, lab):
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


def test_lost_points_are_drawn_and_all_are_counted(session, lab):
    whole = session.view.agents[0]
    session.update(corruption="point_dropping", color_by="fate")
    agent = session.wait_drawn().agents[0]
    assert agent.total + agent.lost == whole.total and len(agent.lost_points) == agent.lost > 0
    drawn = node(session, "/agents/ego_vehicle_1000/lidar/lost").points
    np.testing.assert_allclose(drawn, agent.lost_points, atol=0.05)
    ours = {tuple(point) for point in whole.points.tolist()} - {tuple(point) for point in agent.points.tolist()}
    assert ours == {tuple(point) for point in agent.lost_points.tolist()}
    wait_for(lambda: f"| vehicle 1000 | {agent.total} | 0 | 0 | {agent.lost} |" in counted(lab))
    session.update(color_by="agent")
    session.wait_drawn()
    assert not node(session, "/agents/ego_vehicle_1000/lidar/lost").visible


def test_moved_points_are_counted_as_such(session, lab):
    session.update(corruption="noise", parameters=(("size_m", 0.2),))
    agent = session.wait_drawn().agents[0]
    wait_for(lambda: f"| vehicle 1000 | {agent.total} | 0 | {agent.total} | 0 |" in counted(lab))


def test_clean_and_back_keeps_the_parameters(session):
    session.update(corruption="noise", severity=2, parameters=(("size_m", 0.2),))
    toggle_corruption(session)
    assert (session.state.corruption, session.state.parameters) == ("clean", ())
    toggle_corruption(session)
    assert (session.state.corruption, session.state.parameters) == ("noise", (("size_m", 0.2),))


def test_a_link_with_parameters_that_do_not_exist_is_refused(model):
    state, _, complaints = read_link("corruption=noise&parameters=loud:3", model, ReviewState())
    assert state == ReviewState(corruption="noise") and "expected size_m" in complaints[0]
    state, _, complaints = read_link("corruption=fog&parameters=extinction:-3", model, ReviewState())
    assert state.parameters == () and "extinction: expected 0 to" in complaints[0]
    tuned = ReviewState(corruption="fog", parameters=(("extinction", 0.123),))
    assert write_link(model, tuned, None) == "corruption=fog&parameters=extinction:0.123"
