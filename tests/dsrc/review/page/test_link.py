"""A link holds a state and a camera, and nothing that is in it can break a page."""

import time
from dataclasses import fields, replace
from urllib.parse import quote

import numpy as np
import pytest

from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.cameras import UP, CameraPose
from dsrc.review.page.link import read_link, write_link
from dsrc.review.page.panels import CONTROLS
from dsrc.review.page.session import Session
from dsrc.review.sources.base import MemorySet
from dsrc.review.state import ReviewState
from tests.dsrc.review.conftest import FakeDetector, FakeDrive
from tests.dsrc.review.page.conftest import SocketBrowser
from tests.dsrc.review.page.session import wait_for

FULL = ReviewState(
    drive=1, frame=7, ego_id=1002, cooperative=False, corruption="fog", severity=5, family="paper",
    corrupted_agents="ego", parameters=(("backscatter", 0.3), ("variant", "v2"), ("rounded", True)), threshold=0.55,
    sensor="vlp-16", carrier="1002", placement=(0.5, -1.25, 3.0, 90.0, -10.0),
    iou=0.7, follow="selected", rings=True, cut=True, ruler=(1.5, -2.0, 30.25, 4.0), color_by="fate",
    hidden=frozenset({1000, -1}), layers_off=frozenset({"bodies", "labels"}), object_id=1003,
    max_points=9000, point_size_m=0.2, camera="chase", speed=0.5, theme="dark",
)  # fmt: skip


@pytest.fixture
def two(drive: FakeDrive, detector: FakeDetector) -> ReviewModel:
    other = type(drive)()
    other.drive = other.drive.with_name("other street")
    return ReviewModel([drive, other], detector)


def test_every_field_of_the_state_is_part_of_the_link() -> None:
    assert {control.field for control in CONTROLS if control.link} == {field.name for field in fields(ReviewState)}


@pytest.mark.parametrize("state", [ReviewState(), FULL, replace(FULL, object_id=None, detection=4, drive=0)])
def test_a_link_restores_the_state_and_the_camera(two: ReviewModel, state: ReviewState) -> None:
    pose = CameraPose(np.array([-34.25, 0.5, 21.0]), np.array([14.0, 0.0, 0.0]), UP)
    link = write_link(two, state, pose)
    read, camera, complaints = read_link(link, two, ReviewState())
    assert read == state and not complaints
    np.testing.assert_allclose(camera.position, pose.position)
    np.testing.assert_allclose(camera.look_at, pose.look_at)


def test_methods_with_any_names_come_back_in_their_order(two: ReviewModel) -> None:
    for name in ("DSRC, ego alone", "50 % & more = #1"):
        two.sources[0].sets[name] = MemorySet(name)
    state = ReviewState(methods=("50 % & more = #1", "DSRC, ego alone", "detector"))
    assert read_link(write_link(two, state, None), two, ReviewState()) == (state, None, [])
    read, _, complaints = read_link("methods=detector|nothing", two, ReviewState())
    assert read == ReviewState() and "methods: expected detector, DSRC, ego alone" in complaints[0]


def test_a_list_of_what_is_broken_comes_back_with_the_run_that_tells_it(two: ReviewModel) -> None:
    two.sources[0].sets["weak"] = MemorySet("weak")
    for state in (
        ReviewState(listed="broken", versus="method weak"),
        ReviewState(listed="fixed", versus="alone", methods=("detector", "weak"), error_method="weak"),
    ):
        assert read_link(write_link(two, state, None), two, ReviewState()) == (state, None, [])
    # The usual other run of corrupted sweeps has two names.
    assert read_link("corruption=fog&against=clean", two, ReviewState())[0] == ReviewState(corruption="fog")


def test_agents_of_a_corruption_are_words_or_ids(two: ReviewModel) -> None:
    for who in ("helpers", "1002,-1"):
        state = ReviewState(corruption="fog", corrupted_agents=who)
        assert read_link(write_link(two, state, None), two, ReviewState()) == (state, None, [])
    read, _, complaints = read_link("who=nobody", two, ReviewState())
    assert read == ReviewState() and "corrupted_agents: expected all, ego, helpers, vehicles, " in complaints[0]


def test_no_number_of_a_camera_is_a_negative_zero(two: ReviewModel) -> None:
    pose = CameraPose(np.array([-34.0, -0.001, 21.0]), np.zeros(3), UP)
    assert write_link(two, ReviewState(), pose) == "view=-34.00,0.00,21.00,0.00,0.00,0.00"


def test_the_link_of_the_start_is_empty(two: ReviewModel) -> None:
    assert write_link(two, ReviewState(), None) == ""


@pytest.mark.parametrize("name", ["town_5.a", "lta_truck, ego, fog 3 + loss:0.5, seed 1", "Gießen & Fulda"])
def test_a_drive_is_named_in_a_link_and_found_again_by_its_name(two: ReviewModel, name: str) -> None:
    two.names[1] = name
    link = write_link(two, ReviewState(drive=1), None)
    assert link == f"drive={quote(name, safe='')}"
    assert read_link(link, two, ReviewState())[0].drive == 1


@pytest.mark.parametrize("name", ["7", "street"])
def test_a_drive_whose_name_says_nothing_is_told_by_its_row(two: ReviewModel, name: str) -> None:
    two.names[1] = name
    two.names[0] = "street"
    assert write_link(two, ReviewState(drive=1), None) == "drive=1"


@pytest.mark.parametrize(
    ("query", "complaint"),
    [
        ("frame=x", "frame: expected a whole number"),
        ("drive=nowhere", "drive"),
        ("score=nan", "score: expected 0 to 1"),
        ("score=7", "score: expected 0 to 1"),
        ("corruption=<b>", "corruption"),
        ("cooperative=yes", "cooperative: expected 0 or 1"),
        ("hidden=1,b", "hidden: expected whole numbers"),
        ("view=1,2,3", "view: expected six numbers"),
        ("view=1,2,3,1,2,3", "view"),
        ("view=1,2,3,inf,2,3", "view"),
        ("off=walls", "off"),
        ("of=nonsense", "of: expected all methods, detector, found nonsense"),
        ("against=method%20nonsense", "against: expected none, alone, found method nonsense"),
        ("against=method%20detector", "against: expected none, alone"),
        ("against=clean", "against: expected none, alone"),
        ("errors=broken", "errors: expected all, missed, false, poor, found broken"),
        ("camera=top", "camera: expected free, chase, bev"),
        ("drive=2", "drive: expected street, other street"),
        ("detection=-1", "detection: expected a whole number, at least 0, found -1"),
    ],
)
def test_a_wrong_part_is_told_and_the_rest_is_taken(two: ReviewModel, query: str, complaint: str) -> None:
    state, pose, complaints = read_link(f"{query}&iou=0.7&unknown=1", two, ReviewState())
    assert state == ReviewState(iou=0.7) and pose is None
    assert len(complaints) == 1 and complaint in complaints[0]


@pytest.mark.parametrize(
    ("query", "shown", "told"),
    [
        ("frame=12", {"frame": 11}, ["frame: expected 0 to 11, found 12"]),
        ("drive=gone&frame=5&object=1003&ego=1002&view=1,2,3,4,5,6", {}, ["drive: expected street, other street"]),
        ("ego=5&frame=3", {"frame": 3}, ["ego: expected agents of frame 3, 1000, 1002, -1, found 5"]),
        ("ego=5&carrier=77&sensor=vlp-16", {"sensor": "vlp-16"}, ["ego", "carrier"]),
        ("hidden=1002,5", {"hidden": frozenset({1002, 5})}, ["hidden: expected agents of frame 0"]),
    ],
)
def test_what_is_gone_is_told_and_the_nearest_is_shown(
    two: ReviewModel, query: str, shown: dict[str, object], told: list[str]
) -> None:
    state, pose, complaints = read_link(query, two, ReviewState())
    assert state == ReviewState(**shown) and pose is None
    assert len(complaints) == len(told) and all(one in text for one, text in zip(told, complaints, strict=True))


@pytest.mark.parametrize(
    ("query", "told"),
    [
        ("object=77", "object: expected one of the objects of street, found 77"),
        ("detection=50", "detection: expected 0 to 4, with a score of 0.3 or more in frame 7, found 50"),
    ],
)
def test_a_selection_that_does_not_exist_is_told_and_let_go(
    app: ReviewApp, connect_browser: type[SocketBrowser], query: str, told: str
) -> None:
    session = connect_browser(app, f"frame=7&{query}").session
    wait_for(lambda: session.state.object_id is None and session.state.detection is None)
    assert session.wait_drawn().index == 7
    assert told in session._told and session._notice.visible


def test_another_drive_is_shown_from_its_first_frame_unless_the_link_names_one(two: ReviewModel) -> None:
    start = ReviewState(frame=7)
    assert [read_link(link, two, start)[0].frame for link in ("", "drive=1", "drive=1&frame=3")] == [7, 0, 3]


def test_a_browser_that_connects_with_a_link_sees_its_frame(
    app: ReviewApp, connect_browser: type[SocketBrowser]
) -> None:
    session = connect_browser(app, "frame=7&camera=chase&view=-20,5,10,0,0,1&score=9&object=1003").session
    assert session.wait_drawn().index == 7
    assert session.view.details.object_id == 1003
    np.testing.assert_allclose(session.client.camera.position, [-20.0, 5.0, 10.0])
    assert "score" in session._notice.content and session._notice.visible


def test_the_link_that_the_address_bar_shows_is_that_of_what_is_drawn(session: Session) -> None:
    session.update(frame=7, iou=0.7)
    session.wait_drawn()
    end = time.monotonic() + 5.0
    while "frame=7&iou=0.7&view=" not in session.address.link:
        assert time.monotonic() < end, session.address.link
        time.sleep(0.02)


def test_a_link_says_what_is_as_ever_where_the_page_begins_with_something_else(two: ReviewModel) -> None:
    two.start = ReviewState(frame=3, corruption="fog", severity=4)
    for state in (ReviewState(), ReviewState(frame=3, corruption="fog"), two.start, ReviewState(drive=1, severity=4)):
        assert read_link(write_link(two, state, None), two, two.start) == (state, None, [])
