"""Ruler, rings, cut walls and what the camera follows, on a page without pixels."""

from types import SimpleNamespace

import numpy as np
import pytest

from dsrc.review.page.panels.ruler import RulerPanel
from dsrc.review.page.session import Session
from dsrc.review.static import StaticPart
from dsrc.review.texts import ruler_report
from sim.geometry import invert, transform_points
from tests.dsrc.review.page.session import node, panel, wait_for


def look_at(session: Session, place: tuple[float, float]) -> SimpleNamespace:
    """Click on a place of the ground, as a browser tells it of a camera 30 m above and 20 m behind."""
    ground = session.view.ego.review_from_body[2, 3]
    target, eye = np.array([*place, ground]), np.array([place[0] - 20.0, place[1], ground + 30.0])
    origin, end = transform_points(session.camera.scene_from_review, np.stack([eye, target]))
    return SimpleNamespace(ray_origin=tuple(origin), ray_direction=tuple((end - origin) / np.linalg.norm(end - origin)))


@pytest.mark.parametrize("camera", ["free", "chase"])
def test_two_clicks_measure_distance_heading_and_time(session: Session, camera: str) -> None:
    session.place_camera(camera)
    session.update(frame=4)
    session.wait_drawn()
    ruler = panel(session, RulerPanel)
    ruler._start()
    ruler._take(look_at(session, (2.0, 1.0)))
    assert session.wait_drawn().state.ruler == (2.0, 1.0) and "second" in ruler.text.content
    ruler._take(look_at(session, (2.0, 31.0)))
    view = session.wait_drawn()
    assert view.state.ruler == (2.0, 1.0, 2.0, 31.0) and not ruler.measuring
    # The ego drives east at 5 m/s.
    assert ruler_report(view) == "30.0 m, 90° left of the ego's heading, 6.0 s at 5.0 m/s"
    assert node(session, "/ruler/text").text == ruler_report(view)
    wait_for(lambda: ruler.text.content == ruler_report(view))
    session.update(ruler=())
    session.wait_drawn()
    assert not node(session, "/ruler/line").visible


def test_a_click_above_the_horizon_measures_nothing(session: Session) -> None:
    ruler = panel(session, RulerPanel)
    ruler._start()
    ruler._take(SimpleNamespace(ray_origin=(0.0, 0.0, 10.0), ray_direction=(1.0, 0.0, 0.1)))
    assert session.state.ruler == () and "below the horizon" in session._notice.content
    ruler._end()
    assert not ruler.measuring and ruler.text.content == ""


def test_rings_lie_around_the_ego_at_their_radii(session: Session) -> None:
    session.update(frame=5, rings=True)
    ego = session.wait_drawn().ego.review_from_body[:3, 3]
    ends = np.asarray(node(session, "/rings/circles").points)
    radii = np.hypot(*(ends - ego)[..., :2].reshape(-1, 2).T)
    assert sorted(set(np.round(radii, 2).tolist())) == [10.0, 25.0, 50.0, 75.0, 100.0]
    np.testing.assert_allclose(node(session, "/rings/50").position[:2], ego[:2] + np.array([50.0, 0.0]))
    session.update(rings=False)
    session.wait_drawn()
    assert not node(session, "/rings/circles").visible and not node(session, "/rings/50").visible


def test_walls_and_plants_are_cut_low_and_grow_again(session: Session) -> None:
    vertices = np.array([[0, 0, 0], [4, 0, 9], [0, 4, 9]], np.float32)
    parts = [StaticPart(name, vertices, np.array([[0, 1, 2]], np.uint32)) for name in ("buildings", "plants", "roads")]
    session.stage.place_world(parts)
    for cut, high in ((True, 1.0), (False, 9.0)):
        session.update(cut=cut)
        session.wait_drawn()
        tops = [float(node(session, f"/world/{part.name}").vertices[:, 2].max()) for part in parts]
        assert tops == [high, high, 9.0]


def test_a_camera_goes_with_the_selected_box_and_waits_where_that_is_gone(session: Session) -> None:
    session.update(object_id=1004, follow="selected")
    session.place_camera("chase")
    view = session.wait_drawn()
    box = view.layers["selected/box"]
    seen = transform_points(session.camera.scene_from_review, box.center)
    np.testing.assert_allclose(seen, [[0.0, 0.0, 0.8]], atol=1e-6)
    # It stands across the road: the camera behind it looks north.
    np.testing.assert_allclose(
        transform_points(invert(session.camera.scene_from_review), np.array([[1.0, 0.0, 0.0]]))[0, :2]
        - box.center[0, :2],
        [0.0, 1.0],
        atol=1e-6,
    )
    before = session.camera.scene_from_review
    session.update(frame=3, object_id=9999)
    session.wait_drawn()
    np.testing.assert_array_equal(session.camera.scene_from_review, before)
