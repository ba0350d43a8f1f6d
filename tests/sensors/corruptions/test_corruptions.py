"""Every corruption of both families: facts on random sweeps and on frames of several agents."""

import itertools
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sensors.corruptions import (
    CLEAN,
    CORRUPTIONS,
    DEFAULT_SEVERITY,
    PAPER_SIX,
    SEVERITIES,
    Family,
    corrupt,
    corrupt_frame,
    drive_seed,
    kinds_of,
    require_corruption,
)
from sensors.corruptions.apply import surface_points
from sensors.corruptions.check import remaining_signal, rows_before, sweep_problems
from sensors.frame import Frame
from sensors.sweep import ADDED, ATTENUATED, KEPT, POINT_FIELDS, Sweep, make_sweep
from sim.errors import DataError, SettingsError
from sim.geometry import invert
from tests.sensors.corruptions.drives import HELPER_ID, World, one_car_frame, street_drive, worlds
from tests.sensors.corruptions.frames import frame
from tests.sensors.corruptions.street import few_discs, same, spinning, street, synth16

KINDS = tuple(CORRUPTIONS)
MODELS: tuple[tuple[str, Family], ...] = tuple(
    (kind, family) for family in ("physical", "paper") for kind in kinds_of(family)
)
WEATHER = tuple(kind for kind in KINDS if CORRUPTIONS[kind].weather)
SWEEP_LEVEL = tuple((kind, family) for kind, family in MODELS if CORRUPTIONS[kind].level == "sweep")
DETERMINISTIC = ("cross_sensor", "field_of_view", "wet_ground")
"""Kinds without randomness."""
LEVELS = st.sampled_from(SEVERITIES)
SEEDS = st.integers(0, 2**32)

each_model = pytest.mark.parametrize(("kind", "family"), MODELS)
on_random_sweeps = settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))


@pytest.fixture(autouse=True, scope="module")
def _few_discs() -> Iterator[None]:
    with few_discs():
        yield


def helper(kind: str, family: Family, sweep: Sweep, severity: int, seed: int, index: int = 3) -> Sweep:
    """Sweep of the second car of a frame under a corruption."""
    return corrupt_frame(one_car_frame(sweep, index), kind, severity, seed, family).agent(HELPER_ID).sweep


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@each_model
@on_random_sweeps
@given(world=worlds, severity=LEVELS, seed=SEEDS)
def test_the_result_is_legal_and_reproducible(
    kind: str, family: Family, world: World, severity: int, seed: int
) -> None:
    sweep = world.sweep()
    for name in POINT_FIELDS:
        getattr(sweep, name).flags.writeable = False  # never in place
    out = helper(kind, family, sweep, severity, seed)
    assert sweep_problems(one_car_frame(sweep, 3).agent(HELPER_ID).sweep, out) == []
    again = helper(kind, family, sweep, severity, seed)
    assert same(out, again) and out.lost == again.lost
    assert out.world_from_lidar.tobytes() == again.world_from_lidar.tobytes()


@each_model
@on_random_sweeps
@given(world=worlds, severity=LEVELS, seed=SEEDS)
def test_fates_tell_the_truth(kind: str, family: Family, world: World, severity: int, seed: int) -> None:
    sweep = world.sweep()
    out = helper(kind, family, sweep, severity, seed)
    left = out[out.object_id != ADDED]
    if len(left) == 0:
        return
    was = sweep[rows_before(left, sweep)]
    kept = left.fate == KEPT
    if family == "physical":
        assert same(left[kept], was[kept])
    # Published snow works on intensities of 8 bits, those of kept points included.
    assert (np.abs(left.intensity[kept] - was.intensity[kept]) <= 1.0 / 255.0).all()
    assert (left.points[kept] == was.points[kept]).all()
    still = kept | (left.fate == ATTENUATED)
    moved = np.linalg.norm(left.points - was.points, axis=1)
    # Rain makes ranges noisier by millimetres, which is no displacement.
    assert (moved[still] <= (0.5 if kind == "rain" else 1e-5)).all()
    assert (left.object_id == was.object_id).all() and (left.material == was.material).all()
    if (kind, family) != ("snow", "paper"):  # where flakes can make their target brighter
        dimmed = left.fate == ATTENUATED
        assert (left.intensity[dimmed] <= was.intensity[dimmed] + 1e-6).all()


def test_an_empty_sweep_of_an_unknown_sensor_stays_empty() -> None:
    empty = replace(street(spinning(4))[:0], spec=None)
    for kind, family in MODELS:
        assert len(helper(kind, family, empty, 5, 1)) == 0, (kind, family)


@pytest.mark.parametrize("family", ["physical", "paper"])
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data(), world=worlds, severity=LEVELS, seed=SEEDS)
def test_corruptions_can_be_chained(
    family: Family, data: st.DataObject, world: World, severity: int, seed: int
) -> None:
    first, second = (data.draw(st.sampled_from(kinds_of(family))) for _ in range(2))
    clean = one_car_frame(world.sweep(), 3)
    once = corrupt_frame(clean, first, severity, seed, family)
    twice = corrupt_frame(once, second, severity, seed + 1, family)
    before, after = (f.agent(HELPER_ID).sweep for f in (once, twice))
    assert sweep_problems(before, after) == []
    assert after.lost >= before.lost
    # What the first one made is never taken for a return of a surface.
    assert surface_points(after) <= surface_points(before)


@each_model
def test_another_seed_gives_other_bytes(kind: str, family: Family) -> None:
    if kind in DETERMINISTIC:
        pytest.skip("deterministic")
    clean = street_drive()[1]
    one, other = (corrupt_frame(clean, kind, 5, seed, family).agent(HELPER_ID).sweep for seed in (1, 2))
    assert not (same(one, other) and np.array_equal(one.world_from_lidar, other.world_from_lidar))


@each_model
def test_the_lowest_severity_changes_a_street(kind: str, family: Family) -> None:
    clean = street_drive()[1]
    out = corrupt_frame(clean, kind, 1, 4, family)
    pairs = [(a.sweep, b.sweep) for a, b in zip(clean.agents, out.agents, strict=True)]
    assert any(not same(a, b) or not np.array_equal(a.world_from_lidar, b.world_from_lidar) for a, b in pairs)
    assert [sweep_problems(before, after) for before, after in pairs] == [[]] * len(pairs)


@pytest.mark.parametrize("kind", KINDS)
def test_a_higher_severity_leaves_less_of_a_drive(kind: str) -> None:
    drive = street_drive()
    outs = [[corrupt_frame(clean, kind, severity, 4) for clean in drive] for severity in SEVERITIES]
    count = [sum(surface_points(agent.sweep) for out in made for agent in out.agents) for made in outs]
    assert all(a >= b for a, b in itertools.pairwise(count)), count
    left = [sum(remaining_signal(out, clean) for out, clean in zip(made, drive, strict=True)) for made in outs]
    assert left[0] < sum(len(agent.sweep) for clean in drive for agent in clean.agents)
    assert all(a > b for a, b in itertools.pairwise(left)), left


def test_the_default_settings_are_severity_3() -> None:
    for kind, family in MODELS:
        make = CORRUPTIONS[kind].settings_of(family)
        assert make() == make.severity(DEFAULT_SEVERITY), (kind, family)  # type: ignore[operator]


@pytest.mark.parametrize(("kind", "family"), SWEEP_LEVEL)
def test_a_sensor_of_many_rings_works(kind: str, family: Family) -> None:
    sweep = street(spinning(300, columns=60))
    out = corrupt(sweep, kind, 3, rng(), family)
    assert sweep_problems(sweep, out) == []
    assert len(out) > 0


@pytest.mark.parametrize(("kind", "family"), SWEEP_LEVEL)
def test_a_sweep_of_an_unknown_sensor_works(kind: str, family: Family) -> None:
    out = corrupt(synth16(), kind, 3, rng(), family)
    assert 0 < len(out) <= len(synth16())
    assert out.lost == len(synth16()) - surface_points(out)


def test_the_six_corruptions_of_the_paper_come_first_and_are_in_both_families() -> None:
    assert PAPER_SIX == ("beam_missing", "motion_blur", "fog", "snow", "crosstalk", "cross_sensor") == KINDS[:6]
    assert set(PAPER_SIX) <= set(kinds_of("paper")) <= set(kinds_of("physical")) == set(KINDS)


def test_families_are_never_mixed() -> None:
    for kind in kinds_of("paper"):
        settings = [CORRUPTIONS[kind].settings_of(family) for family in ("physical", "paper")]
        physical, paper = (each.__module__ for each in settings)
        assert physical.startswith("sensors.corruptions.") and paper.startswith("sensors.corruptions.published.")
        assert not physical.startswith("sensors.corruptions.published")


def test_clean_returns_its_input() -> None:
    sweep, whole = street(), frame()
    assert corrupt(sweep, CLEAN, 3, rng()) is sweep
    assert corrupt_frame(whole, CLEAN, 3, 0) is whole


@pytest.mark.parametrize(
    ("kind", "severity", "family", "message"),
    [
        ("fogg", 3, "physical", "unknown corruption 'fogg'; did you mean 'fog'?"),
        ("fog", 0, "physical", "1 to 5, found 0"),
        ("snow", 6, "paper", "1 to 5, found 6"),
        ("fog", 3, "papier", "unknown family of corruptions 'papier'; did you mean 'paper'?"),
        ("pose_error", 3, "paper", "'pose_error' has no published model; family 'paper' has beam_missing"),
    ],
)
def test_a_wrong_kind_severity_or_family_is_refused_in_one_line(
    kind: str, severity: int, family: Family, message: str
) -> None:
    for call in (
        lambda: require_corruption(kind, severity, family),
        lambda: corrupt(street(spinning(4)), kind, severity, rng(), family),
        lambda: corrupt_frame(frame(), kind, severity, 0, family),
    ):
        with pytest.raises(SettingsError) as caught:
            call()
        assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if CORRUPTIONS[kind].level == "frame"])
def test_a_frame_level_kind_refuses_sweeps(kind: str) -> None:
    with pytest.raises(SettingsError, match=f"'{kind}' acts on whole frames: use corrupt_frame"):
        corrupt(street(spinning(4)), kind, 3, rng())


def test_an_error_of_a_sweep_names_its_agent() -> None:
    blind = make_sweep(rng().normal(0.0, 10.0, (500, 3)))
    with pytest.raises(DataError, match="frame 4: agent 1000: "):
        corrupt_frame(frame(4, sweep=blind), "beam_missing", 3, 0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            {"intensity": [4.0, 255.0, 9.0]},
            "intensity: expected 0 to 1 (divide those of 8 bits by 255), found 4 to 255",
        ),
        ({"intensity": [-0.1, 0.5, 0.5]}, "found -0.1 to 0.5"),
        ({"intensity": [0.1, np.nan, 0.5]}, "found nan to nan"),
        (
            {"points": [[1, 2, 3], [np.nan, 2, 3], [1, np.inf, 3]]},
            "points: expected finite coordinates, found nan or inf",
        ),
    ],
)
def test_nan_points_and_intensities_of_another_scale_are_refused(wrong: dict, message: str) -> None:
    points = np.array(wrong.get("points", np.eye(3) * 9.0))
    sweep = make_sweep(points, ring=np.array([0, 1, 2]), intensity=np.array(wrong.get("intensity", [0.1, 0.2, 0.3])))
    for kind in ("fog", "spray"):
        with pytest.raises(DataError) as caught:
            corrupt_frame(frame(4, sweep=sweep), kind, 3, 0)
        assert message in str(caught.value) and str(caught.value).startswith("frame 4: agent ")
    with pytest.raises(DataError, match="sweep: "):
        corrupt(sweep, "fog", 3, rng())


# One weather per scene, faults of each agent ------------------------------------------------------------------------


def settings_of(monkeypatch: pytest.MonkeyPatch, kind: str, index: int, seed: int = 4) -> list:
    """Settings of each agent of a frame."""
    seen: list = []
    plain = CORRUPTIONS[kind]
    name = "apply" if plain.in_frame is None else "in_frame"

    def spy(*given: object) -> Sweep:
        seen.append(given[-2])
        return getattr(plain, name)(*given)

    with monkeypatch.context() as patch:
        patch.setitem(CORRUPTIONS._values, kind, replace(plain, **{name: spy}))
        corrupt_frame(frame(index), kind, 3, seed)
    return seen


@pytest.mark.parametrize("kind", WEATHER)
def test_weather_is_shared_by_all_agents_and_drifts_over_a_drive(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made = {index: settings_of(monkeypatch, kind, index) for index in (0, 1, 400)}
    for seen in made.values():
        assert len(seen) == 3 and seen[0] == seen[1] == seen[2]
    base = CORRUPTIONS[kind].settings.severity(3)
    assert made[0][0] != base != made[400][0] != made[0][0]
    assert settings_of(monkeypatch, kind, 0, seed=5) != made[0]


def test_two_agents_measure_the_same_slowly_drifting_fog() -> None:
    def extinction(index: int, row: int) -> float:
        clean = frame(index)
        out = corrupt_frame(clean, "fog", 3, 4).agents[row].sweep
        through = out[out.fate == ATTENUATED]
        was = clean.agents[row].sweep[rows_before(through, clean.agents[row].sweep)]
        return float(np.median(np.log(was.intensity / through.intensity) / (2.0 * was.range)))

    here, there, later, much_later = (extinction(i, row) for i, row in ((0, 0), (0, 1), (1, 0), (200, 0)))
    assert here == pytest.approx(there, rel=1e-4)
    assert 0.0 < abs(here - later) / here < 0.005 < abs(here - much_later) / here < 0.3


def test_published_models_do_not_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    if "fog" not in kinds_of("paper"):
        pytest.skip("no published fog")
    made = CORRUPTIONS["fog"].settings_of("paper")
    seen: list = []
    plain = CORRUPTIONS["fog"]
    spy = replace(plain, paper_apply=lambda *given: seen.append(given[-2]) or plain.paper_apply(*given))  # type: ignore[misc,func-returns-value]
    monkeypatch.setitem(CORRUPTIONS._values, "fog", spy)
    for index in (0, 400):
        corrupt_frame(frame(index), "fog", 3, 4, "paper")
    assert seen == [made.severity(3)] * 6


@each_model
def test_agents_of_a_frame_are_corrupted_independently(kind: str, family: Family) -> None:
    if kind in DETERMINISTIC:
        pytest.skip("deterministic")
    clean = frame(agents=(999, 1000, 1003))
    out = corrupt_frame(clean, kind, 5, 4, family)
    one, other = (
        (
            out.agents[row].sweep,
            invert(clean.agents[row].sweep.world_from_lidar) @ out.agents[row].sweep.world_from_lidar,
        )
        for row in (1, 2)
    )
    assert not (same(one[0], other[0]) and np.allclose(one[1], other[1], atol=1e-9))


@each_model
def test_an_agent_is_corrupted_independently_of_other_agents_and_frames(kind: str, family: Family) -> None:
    alone = corrupt_frame(frame(5, agents=(1000, 1003)), kind, 3, 4, family)
    corrupt_frame(frame(9), kind, 3, 4, family)
    together = corrupt_frame(frame(5), kind, 3, 4, family)
    assert same(alone.agent(1003).sweep, together.agent(1003).sweep)


@each_model
def test_any_order_gives_the_same_bytes(kind: str, family: Family) -> None:
    orders = ([0, 1, 2], [2, 0, 1])
    made = [{i: digest(corrupt_frame(frame(i), kind, 4, 9, family)) for i in order} for order in orders]
    assert made[0] == made[1]


def digest(out: Frame) -> bytes:
    parts = [getattr(a.sweep, name).tobytes() for a in out.agents for name in POINT_FIELDS]
    return b"".join([*parts, *(a.sweep.world_from_lidar.tobytes() + bytes([a.sweep.lost % 256]) for a in out.agents)])


def digest_of(task: tuple[str, Family, int]) -> bytes:
    kind, family, index = task
    with few_discs():
        return digest(corrupt_frame(frame(index), kind, 4, 9, family))


@pytest.mark.slow
def test_a_fresh_process_gives_the_same_bytes() -> None:
    """Independence of tables, pools and global generators of the process."""
    tasks = [(kind, family, index) for kind, family in MODELS for index in (3,)]
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        elsewhere = list(pool.map(digest_of, tasks))
    assert elsewhere == [digest_of(task) for task in reversed(tasks)][::-1]


def test_dead_beams_stay_dead_over_a_drive() -> None:
    out = [corrupt_frame(frame(index), "beam_missing", 3, seed=4) for index in (0, 7)]
    for agent_id in (1000, 1003, -1):
        first, later = (set(f.agent(agent_id).sweep.ring) for f in out)
        assert first == later
    assert set(out[0].agent(1000).sweep.ring) != set(out[0].agent(1003).sweep.ring)


@pytest.mark.parametrize("kind", [k for k in KINDS if not CORRUPTIONS[k].steady and k not in DETERMINISTIC])
def test_other_draws_differ_from_frame_to_frame(kind: str) -> None:
    first, later = (corrupt_frame(frame(index), kind, 5, seed=4).agents[0].sweep for index in (0, 1))
    assert not same(first, later)


def test_ground_truth_stays() -> None:
    whole = street_drive()[0]
    for kind in KINDS:
        out = corrupt_frame(whole, kind, 5, 0)
        assert out.truth is whole.truth and out.points_on is whole.points_on and out.velocity is whole.velocity
        assert (out.index, out.time_s) == (whole.index, whole.time_s)


def test_drives_of_one_run_have_seeds_of_their_own() -> None:
    seeds = {drive_seed(seed, name) for seed in (0, 1) for name in ("a", "b", "c")}
    assert len(seeds) == 6 and drive_seed(0, "a") == drive_seed(0, "a")
