import numpy as np
import pytest

from dsrc.review.palette import AGENT_COLORS, FATE_COLORS, LOOKS
from dsrc.review.points import point_colors, subsample
from dsrc.review.state import COLOR_BY, ColorBy, Theme
from sensors.sweep import KEPT, SCATTERED, Sweep, make_sweep
from sim.geometry import invert, pose_matrix, transform_points

UPRIGHT = np.array([0.0, 0.0, 1.0, 1.8])


def ground(n: int = 20_000, actors: int = 500) -> Sweep:
    rng = np.random.default_rng(3)
    radius = rng.uniform(3.0, 80.0, n) ** 1.0
    angle = rng.uniform(0, 2 * np.pi, n)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, -1.8)], axis=1)
    ids = np.full(n, -1)
    ids[:actors] = 1000
    return make_sweep(points, object_id=ids, ring=np.arange(n) % 64, intensity=rng.random(n))


@pytest.mark.parametrize("limit", [1, 50, 999, 7000, 19_999, 20_000, 50_000])
def test_thinning_keeps_the_limit_and_the_order(limit: int) -> None:
    rows = subsample(ground(), limit)
    assert len(rows) <= limit
    assert (np.diff(rows) > 0).all()
    assert len(rows) >= min(limit, 20_000) // 2


def test_thinning_keeps_points_on_actors_before_the_ground() -> None:
    sweep = ground()
    rows = subsample(sweep, 3000)
    assert np.count_nonzero(sweep.object_id[rows] >= 0) == 500


def test_thinning_takes_more_from_what_is_near() -> None:
    sweep = ground(actors=0)
    share = [
        np.isin(np.flatnonzero(band), subsample(sweep, 4000)).mean() for band in (sweep.range < 20, sweep.range > 60)
    ]
    assert share[0] < share[1]


def test_points_that_float16_cannot_hold_are_not_drawn() -> None:
    sweep = make_sweep(np.array([[1.0, 0, 0], [np.nan, 0, 0], [np.inf, 0, 0], [70_000.0, 0, 0]]))
    assert subsample(sweep, 100).tolist() == [0]


@pytest.mark.parametrize("color_by", COLOR_BY)
def test_every_colouring_gives_one_colour_per_point(color_by: ColorBy) -> None:
    for sweep in (ground(100), ground(0, 0)):
        colors = point_colors(sweep, color_by, AGENT_COLORS[0], UPRIGHT)
        assert colors.shape == (len(sweep), 3) and colors.dtype == np.uint8


@pytest.mark.parametrize("theme", LOOKS)
def test_road_users_stand_out_in_their_agents_colour_and_the_ground_is_faint(theme: Theme) -> None:
    for color_by, strong in (("agent", (200, 100, 50)), ("verdict", LOOKS[theme].ink)):
        colors = point_colors(ground(1000, 10), color_by, (200, 100, 50), UPRIGHT, theme=theme).astype(int)
        assert (colors[:10] == strong).all()
        faint = np.abs(colors[10:] - LOOKS[theme].faded).max()
        assert faint < 0.2 * np.abs(np.array(strong) - LOOKS[theme].faded).max()


def test_a_tilted_sensor_sees_the_road_at_no_height() -> None:
    body_from_lidar = pose_matrix([0.0, 0.0, 1.8], 0.0, 0.4)
    road = ground(1000, 0)
    tilted = make_sweep(transform_points(invert(body_from_lidar) @ pose_matrix([0.0, 0.0, 1.8]), road.points))
    for color_by in ("height", "agent"):
        seen = [
            point_colors(one, color_by, (200, 100, 50), up)
            for one, up in ((road, UPRIGHT), (tilted, body_from_lidar[2]))
        ]
        # One of the 256 steps of the scale.
        assert np.abs(seen[0].astype(int) - seen[1]).max() <= 4


def test_fates_have_their_colours() -> None:
    sweep = make_sweep(np.zeros((2, 3)), fate=np.array([KEPT, SCATTERED]))
    assert point_colors(sweep, "fate", (1, 2, 3), UPRIGHT).tolist() == [
        list(FATE_COLORS[KEPT]),
        list(FATE_COLORS[SCATTERED]),
    ]
