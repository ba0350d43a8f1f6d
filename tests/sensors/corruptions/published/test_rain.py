"""Rain as published."""

import numpy as np
import pytest

from sensors.corruptions.physics.levels import DEFAULT_SEVERITY, SEVERITIES
from sensors.corruptions.published.cloud import RandomSource
from sensors.corruptions.published.rain import (
    DROP,
    ICE,
    LOST,
    PUBLISHED,
    TARGET,
    WATER,
    Drops,
    PaperRain,
    RainyCloud,
    Sampler,
    apply_rain,
    corrupt,
    drop_power,
    efficiency,
    expected_drops,
    extinction,
    sizes_of,
)
from sensors.sweep import ADDED, ATTENUATED, POINT_FIELDS, SCATTERED
from sim.errors import SettingsError
from tests.sensors.corruptions.published.goldens import agrees, arrays, cloud, table
from tests.sensors.corruptions.street import on_a_ray, rows_of, same, spinning, street

EDGES_M = (0.0, 10.0, 20.0, 40.0, 80.0, np.inf)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def draw_in_turn(reach: np.ndarray, power: np.ndarray, settings: PaperRain, rng: RandomSource) -> Drops:
    """Draw the drops of one beam after the other, as LISA does.

    A number to round n, n ranges, diameters of the drops beyond r_min, a normal number if the target is reported.
    """
    sizes, expected = settings.sizes, expected_drops(reach, settings)
    shake = np.zeros(len(reach))
    ranges, diameters = [np.zeros(0)], [np.zeros(0)]
    for row in np.flatnonzero(power > 0.0):
        number = int(expected[row]) + (rng.random() < expected[row] - int(expected[row]))
        range_m = reach[row] * rng.random(number) ** (1.0 / 3.0)
        range_m = range_m[range_m > settings.range_min_m]
        diameter_mm = settings.smallest_mm - np.log(1.0 - rng.random(len(range_m))) / sizes.rate
        reported = power[row] >= settings.weakest
        if settings.echo == "strongest":
            reported &= power[row] >= drop_power(range_m, diameter_mm, settings).max(initial=0.0)
        shake[row] = rng.normal() if reported else 0.0
        ranges.append(range_m)
        diameters.append(diameter_mm)
    beam = np.repeat(np.flatnonzero(power > 0.0), [len(r) for r in ranges[1:]])
    return Drops(beam, np.concatenate(ranges), np.concatenate(diameters), shake)


def extinction_at(rate: float) -> float:
    golden = arrays("lisa_tables")
    return float(golden["rain_alpha"][golden["rain_rates"].tolist().index(rate)])


@pytest.mark.parametrize("echo", ["strongest", "last"])
@pytest.mark.parametrize("rate", [10, 50])
def test_a_legacy_generator_rains_as_the_release(rate: int, echo: str) -> None:
    settings = PaperRain(rate_mm_h=rate, echo=echo, extinction=extinction_at(rate))  # type: ignore[arg-type]
    golden, name = arrays("lisa_synth16"), f"rain{rate}_{echo}"
    out = apply_rain(cloud("synth16"), settings, np.random.RandomState(1205), draw=draw_in_turn)
    assert (out.label == golden[f"{name}_label"]).all()
    assert np.allclose(out.intensity[::5], golden[f"{name}_intensity_every_5th"], atol=1e-6)
    assert np.allclose(out.range_m[::5], golden[f"{name}_range_every_5th"], atol=1e-4)


def stat_cases() -> list[str]:
    return [case for case in table("lisa") if "_strongest/" in case]


@pytest.mark.parametrize("case", stat_cases())
def test_drops_that_matter_are_all_the_drops_that_matter(case: str) -> None:
    kind, rate, _ = case.split("/")[0].split("_")
    law = "marshall_palmer" if kind == "rain" else "gunn_marshall"
    settings = PaperRain(rate_mm_h=float(rate[1:]), law=law)  # type: ignore[arg-type]
    before, theirs = cloud("synth64")[::8].astype(np.float64), table("lisa")[case]
    reach = np.linalg.norm(before[:, :3], axis=1)
    runs = [apply_rain(before, settings, rng(seed)) for seed in range(100, 120)]

    def each(label: int) -> list[np.ndarray]:
        return [np.histogram(reach[run.label == label], EDGES_M)[0] for run in runs]

    seeds = theirs["n_seeds"]
    # Where five seeds of the golden agree by chance, their spread is no error.
    slack = 4.0 if seeds < 20 else 3.0
    assert agrees([np.bincount(run.label, minlength=3) for run in runs], theirs["n_label"], slack, seeds)
    assert agrees(each(DROP), theirs["scattered_by_range"], slack, seeds)
    lost = np.mean(each(LOST), axis=0)
    assert np.allclose(lost, theirs["lost_by_range"]["mean"], rtol=0.05, atol=1.5)
    hit = [run for run in runs if (run.label == DROP).any()]
    quantiles = [np.quantile(run.range_m[run.label == DROP], [0.05, 0.5, 0.95]) for run in hit]
    assert np.allclose(np.mean(quantiles, axis=0), theirs["scattered_range_q_5_50_95"]["mean"], rtol=0.12)


@pytest.mark.parametrize("case", ["chu_hogg_fog", "moderate_advection_fog", "strong_advection_fog"])
def test_a_medium_without_drops_loses_as_many_points(case: str) -> None:
    theirs = table("lisa")[f"{case}/synth64_stride8"]
    out = apply_rain(cloud("synth64")[::8], PUBLISHED[f"lisa_{case}"], rng())
    assert abs((out.label == LOST).sum() - theirs["n_lost"]["mean"]) <= 0.002 * len(out.label)
    exact = PaperRain(echo="average", extinction=float(arrays("lisa_tables")[f"{case}_alpha_beta"][0]))
    assert (apply_rain(cloud("synth64")[::8], exact, rng()).label == LOST).sum() == theirs["n_lost"]["mean"]


def test_goodin_s_rain_is_the_published_one() -> None:
    theirs = table("lisa")["goodin_R10/synth64_stride8"]
    before = cloud("synth64")[::8]
    out = apply_rain(before, PaperRain(rate_mm_h=10.0, echo="goodin"), rng())
    assert (out.label == LOST).sum() == theirs["n_lost"]["mean"]
    assert np.isclose(out.intensity.mean(), theirs["mean_int"]["mean"], rtol=1e-5)
    reach = np.linalg.norm(before[:, :3].astype(np.float64), axis=1)
    error = ((out.range_m - reach) / reach)[out.label == TARGET]
    assert error.std() == pytest.approx(0.02, rel=0.03)


def test_remaining_targets_are_dimmed_with_noisy_ranges() -> None:
    before = np.tile([30.0, 0.0, 0.0, 0.5], (20_000, 1))
    settings = PaperRain(rate_mm_h=10.0)
    out = apply_rain(before, settings, rng())
    stays = out.label == TARGET
    power = 0.5 * np.exp(-60 * settings.alpha) / 900
    assert np.allclose(out.intensity[stays], 0.5 * np.exp(-60 * settings.alpha))
    assert out.range_m[stays].std() == pytest.approx(0.09 / np.sqrt(2 * power / settings.weakest), rel=0.02)
    assert (out.range_m[out.label == DROP] > 1.5).all() and (out.range_m[out.label == DROP] < 30).all()


def test_extinction_computed_here_gives_nearly_the_same() -> None:
    golden = arrays("lisa_synth16")
    out = apply_rain(cloud("synth16"), PaperRain(rate_mm_h=10.0), np.random.RandomState(1205), draw=draw_in_turn)
    assert (out.label == golden["rain10_strongest_label"]).all()
    assert np.allclose(out.intensity[::5], golden["rain10_strongest_intensity_every_5th"], atol=1e-4)


def test_weak_targets_are_lost_or_a_drop_is_seen_instead() -> None:
    before = np.tile([120.0, 0.0, 0.0, 0.01], (20_000, 1))
    strongest = apply_rain(before, PaperRain(rate_mm_h=50.0), rng())
    assert set(np.unique(strongest.label)) == {LOST, DROP}
    last = apply_rain(before, PaperRain(rate_mm_h=50.0, echo="last"), rng())
    assert ((strongest.label == DROP) == (last.label == DROP)).all()  # the same drops are audible
    both = strongest.label == DROP
    assert (last.range_m[both] >= strongest.range_m[both]).mean() > 0.99
    assert (strongest.intensity[strongest.label == LOST] == 0).all()


@pytest.mark.parametrize("draw", [draw_in_turn, None])
def test_points_of_intensity_0_are_lost(draw: Sampler | None) -> None:
    before = np.tile([80.0, 0.0, 0.0, 0.0], (500, 1))
    assert (apply_rain(before, PaperRain(rate_mm_h=50.0), rng(), draw=draw).label == LOST).all()


def test_drawing_in_turn_or_at_once_gives_the_same_law() -> None:
    before = np.tile([60.0, 0.0, 0.0, 0.05], (1500, 1))
    settings = PaperRain(rate_mm_h=50.0)

    def share(out: RainyCloud) -> float:
        return float((out.label == DROP).mean())

    in_turn, at_once = (share(apply_rain(before, settings, rng(), draw=draw)) for draw in (draw_in_turn, None))
    assert abs(in_turn - at_once) < 3 * np.sqrt(2 * in_turn * (1 - in_turn) / 1500)


def test_a_sweep_keeps_its_rays_and_drops_lost_points() -> None:
    sweep = street(spinning(32))
    out = corrupt(sweep, PaperRain(rate_mm_h=50.0, range_max_m=100.0), rng())
    assert 0 < len(out) < len(sweep)
    row = rows_of(out, sweep)
    assert np.linalg.norm(np.cross(out.points, sweep.points[row]), axis=1).max() < 1e-2
    dropped = out.fate == SCATTERED
    assert (out.fate[~dropped] == ATTENUATED).all() and ((out.object_id == ADDED) == dropped).all()
    assert (out.intensity[~dropped] <= sweep.intensity[row][~dropped]).all()


def test_heavier_rain_takes_more() -> None:
    sweep = street(spinning(32))
    lost = [
        len(sweep) - (corrupt(sweep, PaperRain.severity(severity), rng(2)).fate == ATTENUATED).sum()
        for severity in SEVERITIES
    ]
    dim = [corrupt(sweep, PaperRain.severity(severity), rng(2)).intensity.mean() for severity in SEVERITIES]
    assert lost[-1] > lost[0] and (np.diff(dim) < 0).all()
    assert PaperRain() == PaperRain.severity(DEFAULT_SEVERITY)


def test_no_rain_and_no_points_are_legal() -> None:
    sweep = street(spinning(16))
    assert same(corrupt(sweep, PaperRain(rate_mm_h=0.0), rng()), sweep)
    assert same(
        corrupt(sweep, PaperRain.severity(DEFAULT_SEVERITY), rng(3)),
        corrupt(sweep, PaperRain.severity(DEFAULT_SEVERITY), rng(3)),
    )
    for few in (sweep[:0], sweep[:1], on_a_ray(np.array([0.0, 0.5, 300.0]))):
        out = corrupt(few, PaperRain.severity(5), rng())
        assert len(out) <= len(few) and np.isfinite(out.points).all()
        assert all(getattr(out, name).dtype == getattr(few, name).dtype for name in POINT_FIELDS)
    with pytest.raises(SettingsError, match="range_min_m"):
        PaperRain(range_min_m=300.0)


# Sizes and extinction of drops ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("law", "name"), [("marshall_palmer", "rain"), ("gunn_marshall", "snow")])
def test_extinction_and_number_of_drops_are_the_published_ones(law: str, name: str) -> None:
    golden = arrays("lisa_tables")
    for row, rate in enumerate(golden["rain_rates"]):
        sizes = sizes_of(law, rate)  # type: ignore[arg-type]
        assert np.isclose(sizes.number(0.05), golden[f"{name}_n_tot_dst0.05"][row], rtol=1e-12)
        assert np.isclose(extinction(sizes, halved=True), golden[f"{name}_alpha"][row], rtol=0.006)
        if name == "rain":
            assert np.isclose(extinction(sizes, halved=True), golden["rain_alpha"][row], rtol=2e-4)


def test_extinction_is_that_of_another_mie_code() -> None:
    golden = arrays("lisa_tables")
    ours = [extinction(sizes_of("marshall_palmer", rate)) for rate in golden["rain_rates"]]
    assert np.allclose(ours, golden["rain_alpha_pymiescatt"], rtol=2e-4)


def test_lisa_uses_half_the_size_parameter() -> None:
    golden = arrays("lisa_tables")
    size = np.pi * golden["D_mm"] / 905e-6
    small = size < 2.0
    assert np.allclose(efficiency(0.5 * size, WATER)[small], golden["q_ext"][small], rtol=1e-5)
    assert (efficiency(size, WATER)[small] > 5.0 * golden["q_ext"][small]).all()


def test_efficiency_starts_as_rayleigh_has_it_and_ends_at_twice_the_cross_section() -> None:
    tiny = np.array([0.02, 0.04])
    rayleigh = 8.0 / 3.0 * tiny**4 * ((WATER**2 - 1) / (WATER**2 + 2)) ** 2
    assert np.allclose(efficiency(tiny, WATER), rayleigh, rtol=2e-3)
    assert efficiency(np.array([1e6]), ICE)[0] == pytest.approx(2.0, abs=1e-3)
    # The series meets its mean: averaged over the ripple they are the same.
    size = np.linspace(40.0, 60.0, 2000)
    assert efficiency(size, WATER).mean() == pytest.approx((2.0 + 1.9924 * size ** (-2 / 3)).mean(), rel=0.01)


@pytest.mark.parametrize("law", ["marshall_palmer", "gunn_marshall"])
def test_more_rain_takes_more_light(law: str) -> None:
    taken = [extinction(sizes_of(law, rate)) for rate in (0.2, 1.0, 5.0, 25.0)]  # type: ignore[arg-type]
    assert (np.diff(taken) > 0).all()
