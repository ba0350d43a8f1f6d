"""Facts that hold for every corruption, and for frames of several agents."""

import itertools

import numpy as np
import pytest

from sensors.corruptions import CLEAN, CORRUPTIONS, PAPER, check_corruption, corrupt, corrupt_frame
from sensors.frame import AgentFrame, Frame
from sensors.sweep import ADDED, KEPT, MOVED, POINT_FIELDS, SCATTERED, Sweep
from sim.boxes import Boxes
from sim.errors import SettingsError
from tests.sensors.corruptions.street import rows_of, same, spinning, street, synth16

KINDS = tuple(CORRUPTIONS)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def frame(index: int = 0, agents: tuple[int, ...] = (1000, 1003, -1)) -> Frame:
    sweep = street(spinning(16))
    return Frame(
        index=index,
        time_s=0.1 * index,
        agents=tuple(AgentFrame(a, "vehicle" if a > 0 else "roadside", np.eye(4), 0.0, sweep) for a in agents),
        truth=Boxes.zeros(),
        velocity=np.zeros((0, 2)),
        points_on=np.zeros((len(agents), 0), np.int32),
    )


def test_the_six_corruptions_of_the_paper_are_registered() -> None:
    assert KINDS == ("beam_missing", "motion_blur", "fog", "snow", "crosstalk", "cross_sensor")


@pytest.mark.parametrize("kind", KINDS)
def test_the_default_settings_are_severity_3(kind: str) -> None:
    assert CORRUPTIONS[kind].settings() == CORRUPTIONS[kind].settings.severity(PAPER)


@pytest.mark.parametrize("kind", KINDS)
def test_one_seed_gives_the_same_bytes(kind: str) -> None:
    sweep = street()
    assert same(corrupt(sweep, kind, 3, rng()), corrupt(sweep, kind, 3, rng()))


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"cross_sensor"}))
def test_another_seed_gives_other_bytes(kind: str) -> None:
    sweep = street()
    assert not same(corrupt(sweep, kind, 5, rng(1)), corrupt(sweep, kind, 5, rng(2)))


@pytest.mark.parametrize("kind", KINDS)
def test_the_input_is_never_changed(kind: str) -> None:
    sweep = street()
    for name in POINT_FIELDS:
        getattr(sweep, name).flags.writeable = False
    corrupt(sweep, kind, 5, rng())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("severity", range(1, 6))
def test_types_and_intensities_stay_legal(kind: str, severity: int) -> None:
    sweep = street()
    out = corrupt(sweep, kind, severity, rng())
    for name in POINT_FIELDS:
        assert getattr(out, name).dtype == getattr(sweep, name).dtype
    assert np.isfinite(out.points).all()
    assert out.intensity.min() >= 0.0 and out.intensity.max() <= 1.0
    assert len(out) <= len(sweep)
    assert ((out.object_id == ADDED) == (out.fate == SCATTERED)).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("spec", [None, spinning(), spinning(1)], ids=["unknown", "64", "1"])
def test_an_empty_sweep_stays_empty(kind: str, spec: object) -> None:
    empty = Sweep(**{**_fields(street()[:0]), "spec": spec})
    assert len(corrupt(empty, kind, 5, rng())) == 0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rings", [1, 16, 40, 300])
def test_a_sensor_of_any_number_of_rings_works(kind: str, rings: int) -> None:
    sweep = street(spinning(rings, columns=60))
    out = corrupt(sweep, kind, 3, rng())
    assert len(out) > 0
    assert set(np.unique(out.ring)) <= set(np.unique(sweep.ring))


@pytest.mark.parametrize("kind", KINDS)
def test_a_sweep_of_an_unknown_sensor_works(kind: str) -> None:
    out = corrupt(synth16(), kind, 3, rng())
    assert 0 < len(out) <= len(synth16())


@pytest.mark.parametrize("kind", KINDS)
def test_a_higher_severity_loses_more(kind: str) -> None:
    sweep = street(spinning(64, columns=720))
    known = [_known(corrupt(sweep, kind, severity, rng()), sweep) for severity in range(1, 6)]
    assert known[0] < 1.0
    assert all(a > b for a, b in itertools.pairwise(known)), known


def test_clean_returns_what_it_got() -> None:
    sweep, whole = street(), frame()
    assert corrupt(sweep, CLEAN, 3, rng()) is sweep
    assert corrupt_frame(whole, CLEAN, 3, 0) is whole


@pytest.mark.parametrize(
    ("kind", "severity", "message"),
    [("fogg", 3, "unknown corruption 'fogg'; did you mean 'fog'?"), ("fog", 0, "1 to 5, found 0"), ("snow", 6, "6")],
)
def test_a_wrong_kind_or_severity_is_one_line(kind: str, severity: int, message: str) -> None:
    for call in (
        lambda: check_corruption(kind, severity),
        lambda: corrupt(street(spinning(4)), kind, severity, rng()),
        lambda: corrupt_frame(frame(), kind, severity, 0),
    ):
        with pytest.raises(SettingsError) as caught:
            call()
        assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"cross_sensor"}))
def test_agents_of_a_frame_are_corrupted_independently(kind: str) -> None:
    out = corrupt_frame(frame(), kind, 5, seed=4)
    first, second, third = (agent.sweep for agent in out.agents)
    assert not same(first, second) and not same(second, third)


@pytest.mark.parametrize("kind", KINDS)
def test_an_agent_is_corrupted_the_same_whoever_else_is_there(kind: str) -> None:
    alone = corrupt_frame(frame(agents=(1003,)), kind, 3, seed=4)
    together = corrupt_frame(frame(), kind, 3, seed=4)
    assert same(alone.agent(1003).sweep, together.agent(1003).sweep)


def test_dead_beams_stay_dead_over_a_drive() -> None:
    out = [corrupt_frame(frame(index), "beam_missing", 3, seed=4) for index in (0, 7)]
    for agent_id in (1000, 1003, -1):
        first, later = (set(f.agent(agent_id).sweep.ring) for f in out)
        assert first == later
    assert set(out[0].agent(1000).sweep.ring) != set(out[0].agent(1003).sweep.ring)


@pytest.mark.parametrize("kind", ["motion_blur", "fog", "snow", "crosstalk"])
def test_other_draws_differ_from_frame_to_frame(kind: str) -> None:
    first, later = (corrupt_frame(frame(index), kind, 5, seed=4).agents[0].sweep for index in (0, 1))
    assert not same(first, later)


def test_ground_truth_stays() -> None:
    whole = frame()
    out = corrupt_frame(whole, "fog", 5, 0)
    assert out.truth is whole.truth and out.points_on is whole.points_on and out.index == whole.index


def _fields(sweep: Sweep) -> dict:
    return {name: getattr(sweep, name) for name in (*POINT_FIELDS, "world_from_lidar", "time_s", "spec")}


def _known(out: Sweep, clean: Sweep) -> float:
    """What is left of a sweep: returns of surfaces, each worth less the farther it was moved."""
    moved = np.linalg.norm(out.points - clean.points[rows_of(out, clean)], axis=1)
    worth = np.where(out.fate == MOVED, np.exp(-moved), 1.0)
    worth = np.where(out.fate == SCATTERED, 0.0, worth)
    assert (moved[out.fate == KEPT] == 0.0).all()
    return float(worth.sum() / len(clean))
