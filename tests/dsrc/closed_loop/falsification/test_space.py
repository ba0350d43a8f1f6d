"""Texts of faults with ranges, parameters of encounters, and the points that optimisers make of them."""

import msgspec
import pytest

from dsrc.closed_loop.falsification.optimizers import OptimizerName, open_optimizer
from dsrc.closed_loop.falsification.space import Point, Space, Template, parameters_of
from sim.catalog.load import load_scenario
from sim.errors import SettingsError

TEXT = "brake_gain:0.2..1 from 0..6 s for 0.5..6 s + fog:1..5 on helpers"


def test_a_text_with_ranges_is_a_fault_at_every_share_of_them() -> None:
    template = Template.parse(TEXT, "search")
    assert [one.name for one in template.dimensions] == ["brake_gain.factor 0", "from 0", "for 0", "fog.severity 1"]
    gain, fog = template.faults((0.5, 0.5, 1.0, 0.6))
    assert (gain.value, gain.from_s, gain.to_s) == (0.6, 3.0, 9.0)
    assert fog.value == 3.0 and fog.agents == "helpers" and fog.always


def test_the_size_of_a_fault_grows_from_the_end_that_does_nothing() -> None:
    template = Template.parse(TEXT, "search")
    assert template.size((1.0, 0.3, 0.0, 0.0)) == 0.0  # full brakes, the shortest time, the least fog
    assert template.size((0.0, 0.3, 1.0, 1.0)) == 1.0
    assert template.size((0.0, 0.9, 0.0, 0.0)) == 0.25  # of one of two faults one of two numbers
    assert Template.parse("loss:0.3", "search").size(()) == 1.0  # no range says how much
    rate = Template.parse("rate:1..10", "search")
    assert rate.size((1.0,)) == 0.0 and rate.size((0.0,)) == 1.0  # fewer messages are worse


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("fog:5..1", "expected a range LOW..HIGH that rises, found 5..1"),
        ("fog:3..9", "fault 'fog:9', severity: expected a whole number, 1 to 5, found 9"),
        ("frog:1..2", "expected a kind of fault, found frog"),
        ("fog:3 from 1..5 s to 4..9 s", "expected an end after 5 s, found 4 s"),
        ("fog:3 from 1 s to 4 s for 3 s", "expected from, to or for, and on once each"),
    ],
)
def test_a_range_that_holds_no_fault_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(SettingsError) as refused:
        Template.parse(text, "search")
    assert complaint in str(refused.value)


def test_a_parameter_has_the_range_of_its_encounter_or_one_within_what_it_takes() -> None:
    scenarios = {"lta_truck": load_scenario("lta_truck")}
    usual, given = parameters_of(("conflict_mps", "jitter_s=-0.2..0.4"), scenarios)
    assert usual.low < usual.high and (given.low, given.high) == (-0.2, 0.4)
    truck = scenarios["lta_truck"]
    assert truck.conflict is not None
    narrow = msgspec.structs.replace(
        truck, conflict=msgspec.structs.replace(truck.conflict, parameters={"conflict_mps": (9.0, 9.5)})
    )
    (drawn,) = parameters_of(("conflict_mps",), {"narrow": narrow})
    assert (drawn.low, drawn.high) == (9.0, 9.5)
    for text, complaint in (
        ("jitter_s=-9..9", "expected a range LOW..HIGH within -0.5..0.5, found -9..9"),
        ("jitters", "expected a parameter of the encounter 'lta_truck', found jitters; did you mean 'jitter_s'?"),
    ):
        with pytest.raises(SettingsError) as refused:
            parameters_of((text,), scenarios)
        assert complaint in str(refused.value)
    with pytest.raises(SettingsError, match="no encounter"):
        parameters_of(("jitter_s",), {"four_way": load_scenario("four_way")})


def best(name: OptimizerName, space: Space, budget: int, seed: int) -> tuple[float, list[Point]]:
    """Least value of a bowl whose bottom is at 0.3 under the second text, and the points tried."""
    optimizer, points, values = open_optimizer(name, space, budget, seed), list[Point](), list[float]()
    while len(points) < budget:
        asked = optimizer.ask(4)
        told = [abs(point.units[0] - 0.3) + (point.choice[2] == 0) for point in asked]
        optimizer.tell(told)
        points, values = points + asked, values + told
    return min(values), points


def space_of(*texts: str) -> Space:
    return Space(("a",), (0, 1), tuple(Template.parse(text, "search") for text in texts))


@pytest.mark.parametrize("name", ["random", "grid"])
def test_the_points_of_a_seed_are_the_same_again_and_within_the_space(name: OptimizerName) -> None:
    space = space_of("fog:1..5", "control_delay:0..1 from 0..3 s")
    _, points = best(name, space, 40, 3)
    assert points == best(name, space, 40, 3)[1]
    assert {point.choice for point in points} == set(space.choices)
    for point in points:
        assert len(point.units) == len(space.dimensions(point.choice)) and all(0.0 <= u <= 1.0 for u in point.units)
    if name == "grid":  # the ten points of each choice are a grid's, all different
        assert len(set(points)) == 40 - 2 * 5 or len(set(points)) == 40


def test_the_parzen_estimator_comes_closer_than_chance() -> None:
    pytest.importorskip("optuna")
    space = space_of("control_delay:0..1", "latency:0..1")
    closest = {name: [best(name, space, 40, seed)[0] for seed in range(5)] for name in ("tpe", "random")}
    assert sum(closest["tpe"]) < sum(closest["random"])
    assert best("tpe", space, 20, 1) == best("tpe", space, 20, 1)
