"""Incomplete echo: dark and glancing panels of vehicles are lost first, and nothing else."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from sensors.corruptions import FAMILIES, corrupt_frame
from sensors.corruptions import corrupt as corrupt_any
from sensors.corruptions.incomplete_echo import IncompleteEcho, corrupt, in_frame
from sensors.frame import Frame
from sensors.sweep import STATIC, UNKNOWN_MATERIAL, Sweep
from sim.boxes import Boxes
from sim.errors import SettingsError, notice
from tests.sensors.corruptions.drives import MATERIAL, street_drive
from tests.sensors.corruptions.street import same, spinning, street


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def cars(sweep: Sweep | None = None) -> Sweep:
    """A street with a white car, a black car and a person instead of some rings."""
    sweep = street() if sweep is None else sweep
    object_id = np.select([sweep.ring == 30, sweep.ring == 40, sweep.ring == 50], [1000, 1001, 1002], STATIC)
    paint = [MATERIAL["paint_white"], MATERIAL["paint_black"], MATERIAL["skin"]]
    material = np.select([sweep.ring == 30, sweep.ring == 40, sweep.ring == 50], paint, UNKNOWN_MATERIAL)
    intensity = np.select([sweep.ring == 30, sweep.ring == 40, sweep.ring == 50], [0.7, 0.05, 0.5], sweep.intensity)
    return replace(
        sweep,
        object_id=object_id.astype(np.int32),
        material=material.astype(np.uint8),
        intensity=intensity.astype(np.float32),
    )


@pytest.mark.parametrize("severity", range(1, 6))
def test_vehicles_lose_their_share_and_nothing_else_does(severity: int) -> None:
    sweep = cars()
    out = corrupt(sweep, IncompleteEcho.severity(severity), rng())
    on, left = (np.isin(s.object_id, [1000, 1001]) for s in (sweep, out))
    assert left.sum() == on.sum() - int(IncompleteEcho.LEVELS["share"][severity - 1] * on.sum())
    assert same(out[~left], sweep[~on])
    assert {tuple(p) for p in out.points} <= {tuple(p) for p in sweep.points}


def test_dark_paint_goes_first() -> None:
    out = corrupt(cars(), IncompleteEcho(share=0.4), rng())
    assert (out.object_id == 1000).sum() > 0.98 * (cars().object_id == 1000).sum()
    assert (out.object_id == 1001).sum() < 0.25 * (cars().object_id == 1001).sum()


def test_grazing_panels_go_first_where_intensity_is_uninformative() -> None:
    sweep = cars(street(spinning(64, columns=900, intensity_law="distance")))
    cosine = np.where(sweep.column % 2 == 0, 0.9, 0.05).astype(np.float32)
    out = corrupt(replace(sweep, cosine=cosine), IncompleteEcho(share=0.25), rng())
    black = out[out.object_id == 1001]
    assert (black.cosine > 0.5).mean() > 0.6


def test_points_lost_at_a_severity_are_lost_at_the_next() -> None:
    left = [
        {tuple(p) for p in corrupt(cars(), IncompleteEcho.severity(severity), rng()).points} for severity in range(1, 6)
    ]
    assert all(a > b for a, b in itertools.pairwise(left))


def test_points_of_unknown_brightness_are_lost_at_random() -> None:
    sweep = replace(cars(), intensity=np.zeros(len(cars()), np.float32))
    out = corrupt(sweep, IncompleteEcho(share=0.5), rng())
    for car in (1000, 1001):
        assert (out.object_id == car).sum() == pytest.approx(0.5 * (sweep.object_id == car).sum(), rel=0.2)


def test_vehicles_of_a_frame_are_found_by_ids_or_boxes() -> None:
    clean = street_drive()[1]
    by_id = in_frame(clean, 0, IncompleteEcho.severity(3), rng())
    sweep = clean.agents[0].sweep
    blind = replace(sweep, object_id=np.full(len(sweep), STATIC, np.int32))
    found = in_frame(
        clean.with_sweeps([blind, *(agent.sweep for agent in clean.agents[1:])]), 0, IncompleteEcho.severity(3), rng()
    )
    on = np.isin(sweep.object_id, clean.truth.object_id).sum()
    assert len(sweep) - len(by_id) == int(0.75 * on) > 0
    assert abs(len(found) - len(by_id)) <= 0.05 * on


@pytest.mark.parametrize("family", FAMILIES)
def test_an_unlabelled_cloud_keeps_its_points_and_says_so_once(family: str, caplog: pytest.LogCaptureFixture) -> None:
    def said(clean: Sweep | Frame) -> list[str]:
        notice.cache_clear()
        caplog.clear()
        for _ in range(2):
            if isinstance(clean, Sweep):
                corrupt_any(clean, "incomplete_echo", 3, rng(), family)
            else:
                corrupt_frame(clean, "incomplete_echo", 3, 0, family)
        return [record.getMessage() for record in caplog.records]

    def bare(sweep: Sweep) -> Sweep:
        unknown = np.full(len(sweep), UNKNOWN_MATERIAL, np.uint8)
        return replace(sweep, object_id=np.full(len(sweep), STATIC, np.int32), material=unknown)

    assert same(corrupt_any(bare(cars()), "incomplete_echo", 3, rng(), family), bare(cars()))
    (message,) = said(bare(cars()))
    assert message.startswith("incomplete_echo: expected points with ids of objects, or a frame")
    clean = street_drive()[1]
    with_boxes = clean.with_sweeps([bare(agent.sweep) for agent in clean.agents])
    nothing = np.zeros((len(clean.agents), 0), np.int64)
    (message,) = said(Frame(1, clean.time_s, with_boxes.agents, Boxes.zeros(), np.zeros((0, 2)), nothing))
    assert message.startswith("incomplete_echo: expected points with boxes or ids of objects, found an unlabelled")
    assert said(with_boxes) == said(cars()) == said(cars()[:0]) == []


def test_the_published_model_finds_vehicles_without_ids_by_their_boxes() -> None:
    clean = street_drive()[1]
    on = np.isin(clean.agents[0].sweep.object_id, clean.truth.object_id)
    sweeps = [replace(a.sweep, object_id=np.full(len(a.sweep), STATIC, np.int32)) for a in clean.agents]
    out = corrupt_frame(clean.with_sweeps(sweeps), "incomplete_echo", 3, 0, "paper").agents[0].sweep
    assert len(on) - len(out) == pytest.approx(0.75 * on.sum(), rel=0.05)


def test_no_vehicles_no_share_and_no_points() -> None:
    sweep = street()
    assert same(corrupt(sweep, IncompleteEcho.severity(5), rng()), sweep)
    assert same(corrupt(cars(), IncompleteEcho(share=0.0), rng()), cars())
    assert len(corrupt(sweep[:0], IncompleteEcho.severity(5), rng())) == 0
    assert len(corrupt(cars()[cars().ring == 30][:1], IncompleteEcho.severity(5), rng())) == 1
    with pytest.raises(SettingsError, match="share: expected 0 to 1"):
        IncompleteEcho(share=2.0)
