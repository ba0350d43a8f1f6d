"""An episode log opens as frames of its road users, with what the ego saw, believed and planned."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.types import Outcome, Percept, Tick
from dsrc.review.errors.filters import FP
from dsrc.review.errors.report import place_of, run_report
from dsrc.review.model import ReviewModel
from dsrc.review.sources.base import Setup
from dsrc.review.sources.episodes import PERCEPTS, TRACKS, EpisodeSource, episode_source, planned_way
from dsrc.review.sources.moment import AROUND_M, CELL_M
from dsrc.review.sources.opening import open_sources
from dsrc.review.state import ReviewState
from dsrc.review.view import FrameView
from sensors.frame import AgentFrame, Frame
from sensors.sweep import make_sweep
from sim.boxes import concatenate
from sim.catalog.load import load_scenario
from sim.errors import DataError
from sim.geometry import pose_matrix
from tests.dsrc.closed_loop.logged import EGO_ID, SCENARIO, Mover, ahead, percept_of, ticks_of
from tests.dsrc.closed_loop.perception import toy
from tests.dsrc.closed_loop.perception.test_recast import log_of, message
from tests.dsrc.closed_loop.test_log import full_log
from tests.dsrc.review.conftest import street_frame


@pytest.fixture(scope="module")
def log() -> EpisodeLog:
    return full_log()


@pytest.fixture(scope="module")
def source(log: EpisodeLog) -> EpisodeSource:
    return episode_source(log)


def test_frames_are_the_road_users_of_the_steps(log: EpisodeLog, source: EpisodeSource) -> None:
    assert len(source) == len(log) and source.labelled and SCENARIO.name in source.name
    for row, tick in enumerate(log.ticks):
        frame = source.read(row)
        np.testing.assert_array_equal(frame.truth.array, tick.actors.boxes.array)
        assert [agent.agent_id for agent in frame.agents] == [EGO_ID] and len(frame.agents[0].sweep) == 0
        np.testing.assert_allclose(frame.agents[0].world_from_body[:2, 3], tick.ego.box.center[0, :2])
        assert np.isclose(frame.agents[0].world_from_body[2, 3], tick.ego.box.center[0, 2] - 0.8, atol=0.02)


def test_a_moment_holds_tracks_claims_and_links(log: EpisodeLog, source: EpisodeSource) -> None:
    for row, tick in enumerate(log.ticks):
        moment = source.moment(row)
        np.testing.assert_array_equal(moment.tracks.array, tick.tracks.boxes.array)
        assert (moment.reason, moment.decisive) == (tick.decision.reason, tick.decision.track)
        assert len(moment.claims) == len(moment.claimed_by) == sum(map(len, tick.claims.values()))
        heard = len(moment.links.received)
        assert moment.links.line.shape == (heard, 2, 3)
        if heard:
            np.testing.assert_allclose(moment.links.line[:, 1], tick.ego.box.center[[0] * heard])
    # Step 3 has no percept of its own: that of step 2 is a step older.
    ages = [source.moment(row).percept_age_s for row in (2, 3)]
    assert ages[1] == pytest.approx(ages[0] + 0.1, abs=1e-6)
    assert any(source.moment(row).claimed_by == ("truck",) for row in range(len(log)))


def test_a_timeline_says_how_the_episode_went(log: EpisodeLog, source: EpisodeSource) -> None:
    line = source.timeline()
    assert len(line.time_s) == len(log) and (np.diff(line.time_s) > 0).all()
    contact = next((row for row, tick in enumerate(log.ticks) if tick.contact is not None), None)
    assert line.contact_row == contact and line.outcome == str(log.outcome)


def test_percepts_and_tracks_are_sets_of_detections_around_the_ego(source: EpisodeSource) -> None:
    assert list(source.sets) == [PERCEPTS, TRACKS]
    for name in (PERCEPTS, TRACKS):
        table = source.sets[name].run(Setup())
        assert table.position.tolist() == list(range(len(source)))
        assert EGO_ID not in table.object_id.tolist() and len(table.truth) > 0
        assert (np.hypot(*table.truth[:, :2].T) <= 70.0).all()


def test_a_detection_of_the_ego_itself_is_no_false_one(log: EpisodeLog) -> None:
    tick = log.ticks[0]
    shifts = np.array([[0.4, 0.0, 0.1], [0.0, 10.0, 0.0]])
    boxes = concatenate([replace(tick.ego.box, center=tick.ego.box.center + shift) for shift in shifts])
    live = EpisodeSource("running")
    live.put(replace(tick, percept=Percept(tick.ego.time_s, boxes, np.array([0.9, 0.8]), np.zeros((2, 2)))), EGO_ID)
    (result,) = live.sets[PERCEPTS].run(Setup()).results()
    assert result.detections.score.tolist() == pytest.approx([0.8])


def test_an_episode_stands_in_the_world_of_its_scenario(log: EpisodeLog) -> None:
    settings = msgspec.structs.replace(log.settings, scenario=load_scenario("ped_dartout"), seed=1)
    model = ReviewModel([episode_source(EpisodeLog(settings, log.ticks[0].actors, log.ticks, log.outcome))])
    names = {part.name for part in model.world(0)[0]}
    assert {"roads", "markings", "buildings"} <= names


def test_a_running_episode_grows_step_by_step_and_ends_as_its_log(log: EpisodeLog, source: EpisodeSource) -> None:
    live = EpisodeSource("running")
    with pytest.raises(DataError, match="expected a first frame to come, found 0"):
        live.read(0)
    for row, tick in enumerate(log.ticks):
        assert len(live) == row and not live.ended
        live.put(tick, EGO_ID, lidar=source.senses.lidar(row))
        assert live.timeline().outcome == "running" and len(live.timeline().time_s) == row + 1
    live.end(str(log.outcome), log.message)
    live.end()
    assert live.ended and live.timeline().outcome == str(log.outcome)
    for name in (PERCEPTS, TRACKS):
        ours, theirs = live.sets[name].run(Setup()), source.sets[name].run(Setup())
        np.testing.assert_array_equal(ours.truth, theirs.truth)


def test_sweeps_of_a_log_are_cast_again_once_its_world_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    toy.build(monkeypatch)
    source = episode_source(log_of({4: message(2, 0.2), 6: message(-1, np.nan)}))
    model = ReviewModel([source])
    state = ReviewState(frame=4)
    view = model.view(state)
    assert [agent.total for agent in view.agents] == [0] and view.moment.unseen is None
    source.explain()
    view = model.view(state)
    assert [agent.agent_id for agent in view.agents] == [toy.EGO, toy.HELPER]
    assert all(agent.total > 0 for agent in view.agents)
    assert view.moment.links.senders == (f"helper {toy.HELPER}",) and view.moment.links.age_s == pytest.approx([0.2])
    helped, alone = (model.view(ReviewState(frame=row)) for row in (4, 6))
    behind_the_wall = unseen_at(helped, 30.0, 7.0), unseen_at(alone, 30.0, 7.0)
    assert behind_the_wall == (False, True), "its helper sees the road there"
    assert not unseen_at(alone, 10.0, 0.0)
    hidden = [
        one.agent for one in model.view(ReviewState(frame=4, object_id=toy.HIDDEN)).details.visibility if one.points
    ]
    assert hidden == [f"helper {toy.HELPER}"]


def unseen_at(view: FrameView, x: float, y: float) -> bool:
    """Whether a place of the world is drawn as unseen; the toy's ego stands at its origin."""
    lidar = view.ego.review_from_lidar[:2, 3] - view.ego.review_from_body[:2, 3]
    column, row = ((np.array([x, y]) - lidar + AROUND_M) / CELL_M).astype(int)
    return bool(view.moment.unseen[row, column])


def test_sweeps_that_are_handed_over_are_shown_in_the_latest_frames(
    log: EpisodeLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dsrc.review.sources.episodes.KEPT", 3)
    live = EpisodeSource("running")
    for tick in log.ticks:
        live.put(tick, EGO_ID, street_frame(0))
    points = [sum(len(agent.sweep) for agent in live.read(row).agents) > 0 for row in range(len(live))]
    assert len(live) > 3 and points == [False] * (len(live) - 3) + [True] * 3


def tilted(tick: Tick) -> Frame:
    """Empty sweep of an ego whose LiDAR stands before its middle, lower than most, and looks down."""
    body = pose_matrix(tick.ego.box.center[0] * [1.0, 1.0, 0.0], tick.ego.box.yaw[0])
    sweep = make_sweep(np.zeros((0, 3)), body @ pose_matrix([1.5, 0.0, 1.73], pitch=np.radians(10.0)), 0.0)
    agent = AgentFrame(EGO_ID, "vehicle", body, tick.ego.speed_mps, sweep)
    count = len(tick.actors.boxes)
    return Frame(0, 0.0, (agent,), tick.actors.boxes, np.zeros((count, 2)), np.zeros((1, count), np.int32))


def test_detections_are_drawn_where_they_are_however_the_sensor_is_mounted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dsrc.review.sources.episodes.KEPT", 2)
    movers = [Mover("ego", ahead(10.0)), Mover("car", ahead(10.0, x=25.0, y=-3.0))]
    _, ticks = ticks_of(movers, 4, lambda actors: percept_of(actors, [1]))
    source, aside = EpisodeSource("running"), np.array([0.0, 9.0, 0.0])
    for tick in ticks:
        beside = replace(tick.percept.boxes, center=tick.percept.boxes.center + aside)
        source.put(replace(tick, percept=replace(tick.percept, boxes=beside)), EGO_ID, tilted(tick))
    model = ReviewModel([source])
    for row in range(4):  # the first two are without their sweeps by now
        state = ReviewState(frame=row)
        place = ticks[row].percept.boxes.center + aside - model.origin(0)
        np.testing.assert_allclose(model.view(state).layers["detections/fp"].center, place, atol=1e-5)
        errors = run_report(model, state).errors
        (ghost,) = np.flatnonzero((errors.row == row) & (errors.kind == FP))
        np.testing.assert_allclose(place_of(model, 0, errors, ghost), place[0], atol=1e-5)


def test_a_detection_of_the_ego_is_known_by_its_body_and_not_by_its_sensor(log: EpisodeLog) -> None:
    tick = log.ticks[0]
    corner = replace(tick.ego.box, center=tick.ego.box.center - [1.8, 0.0, 0.0])
    live = EpisodeSource("running")
    live.put(replace(tick, percept=Percept(0.0, corner, np.ones(1), np.zeros((1, 2)))), EGO_ID, tilted(tick))
    assert len(live.sets[PERCEPTS].run(Setup()).score) == 0


def test_sweeps_of_few_steps_are_dropped_in_time(log: EpisodeLog, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dsrc.review.sources.episodes.KEPT", 4)
    live = EpisodeSource("running")
    for row, tick in enumerate(log.ticks):
        live.put(tick, EGO_ID, street_frame(0) if row % 3 == 0 else None)
    points = [sum(len(agent.sweep) for agent in live.read(row).agents) > 0 for row in range(len(live))]
    assert len(live) == 8 and points == [False] * 6 + [True, False]


def test_a_plan_follows_the_route_and_ends_where_the_ego_stands(log: EpisodeLog) -> None:
    from dataclasses import replace

    ego = replace(log.ticks[-1].ego, speed_mps=10.0, route=np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 100.0]]))
    coasting, braking = planned_way(ego, 0.0), planned_way(ego, -5.0)
    np.testing.assert_allclose(coasting[-1], [20.0, 10.0, coasting[0, 2], 10.0], atol=1e-6)
    # v²/2a = 10 m.
    np.testing.assert_allclose(braking[-1, [0, 1]], [10.0, 0.0], atol=0.05)
    assert braking[-1, 3] == pytest.approx(0.0, abs=1e-9)
    assert len(planned_way(replace(ego, route=np.zeros((0, 2))), 1.0)) == 1


def test_logs_open_by_file_and_by_folder(log: EpisodeLog, tmp_path: Path) -> None:
    log.save(tmp_path / "campaign/episodes/b.npz")
    log.save(tmp_path / "campaign/episodes/a.npz")
    assert len(open_sources(tmp_path / "campaign")) == len(open_sources(tmp_path / "campaign/episodes")) == 2
    assert len(episode_source(EpisodeLog.load(tmp_path / "campaign/episodes/a.npz"))) == len(log)
    (opened,) = open_sources(tmp_path / "campaign/episodes/a.npz")
    assert opened.kind == "episode"
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(DataError, match=r"other\.npz: episode"):
        open_sources(tmp_path / "other.npz")


def test_the_traffic_and_the_world_of_a_drive_are_no_episodes(tmp_path: Path) -> None:
    for name in ("traffic", "world"):
        np.savez(tmp_path / f"{name}.npz", version=1)
    with pytest.raises(DataError, match="drive"):
        open_sources(tmp_path)


def test_a_damaged_archive_is_no_episode(log: EpisodeLog, tmp_path: Path) -> None:
    path = log.save(tmp_path / "traffic.npz")
    content = bytearray(path.read_bytes())
    # The end still says that it is an archive; its list of contents is cut.
    at = content.find(b"PK\x01\x02")
    content[at : at + 4] = b"XXXX"
    path.write_bytes(bytes(content))
    with pytest.raises(DataError, match="drive"):
        open_sources(tmp_path)


def test_a_folder_of_episodes_opens_on_a_crash(log: EpisodeLog, tmp_path: Path) -> None:
    for name, outcome in (("a", Outcome.ARRIVED), ("b", Outcome.CRASHED), ("c", Outcome.STUCK)):
        EpisodeLog(log.settings, log.actors[0], log.ticks, outcome).save(tmp_path / f"{name}.npz")
    assert [source.timeline().outcome for source in open_sources(tmp_path)] == ["crashed", "arrived", "stuck"]


@pytest.mark.parametrize(
    ("table", "shown"),
    [("scenario,key\nlta_truck,new\n", 1), ("scenario\nlta_truck\n", 2), ("key\nelsewhere\n", 2), ("\0\xff", 2)],
)
def test_a_campaign_opens_with_the_episodes_of_its_results(
    log: EpisodeLog, tmp_path: Path, table: str, shown: int
) -> None:
    for name in ("new", "of_an_earlier_version"):
        log.save(tmp_path / f"episodes/{name}.npz")
    (tmp_path / "results.csv").write_bytes(table.encode("latin-1"))
    assert len(open_sources(tmp_path)) == shown
