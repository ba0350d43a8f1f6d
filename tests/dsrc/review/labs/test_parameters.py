"""Every setting of every corruption that is a number, a switch or a choice can be set on the page and in a link."""

import msgspec
import pytest

from dsrc.review.labs.parameters import CorruptionParameter, changed, parameters_of, parse_change
from dsrc.review.sources.detected import corrupted_frame
from sensors.corruptions import CORRUPTIONS, FAMILIES, Condition
from sensors.corruptions.registry import Family
from sensors.frame import Frame
from sim.errors import SettingsError

MODELS = [(kind, family) for kind in CORRUPTIONS for family in FAMILIES if parameters_of(kind, 3, family)]


def named(kind: str, severity: int = 3, family: Family = "physical") -> dict[str, CorruptionParameter]:
    return {parameter.name: parameter for parameter in parameters_of(kind, severity, family)}


def test_every_built_in_model_has_parameters() -> None:
    assert {kind for kind, family in MODELS if family == "physical"} == set(CORRUPTIONS)
    assert {kind for kind, family in MODELS if family == "paper"} == {
        kind for kind in CORRUPTIONS if CORRUPTIONS[kind].paper_apply is not None
    }


@pytest.mark.parametrize(("kind", "family"), MODELS)
def test_both_ends_of_every_parameter_are_valid_settings(kind: str, family: Family) -> None:
    for severity in range(1, 6):
        own = CORRUPTIONS[kind].settings_of(family).severity(severity)
        for parameter in parameters_of(kind, severity, family):
            assert getattr(own, parameter.name) == parameter.value
            if not parameter.choices:
                assert parameter.low <= parameter.value <= parameter.high and 0.0 < parameter.step
                assert 1.0 <= (parameter.high - parameter.low) / parameter.step <= 260.0
            for end in parameter.choices or (parameter.low, parameter.high):
                if (kind, family, parameter.name, end) == ("rain", "paper", "range_max_m", parameter.low):
                    continue  # the farthest range is below the nearest
                value = type(parameter.value)(end)
                settings = Condition(kind, severity, family, settings=((parameter.name, value),)).resolved()
                assert getattr(settings, parameter.name) == value
                assert settings == msgspec.structs.replace(own, **{parameter.name: value})


def test_what_tells_the_severities_apart_comes_first() -> None:
    assert next(iter(named("crosstalk"))) == "share"
    assert list(named("point_dropping"))[:2] == ["share", "patches"]


def test_what_is_left_to_the_sensor_is_no_parameter() -> None:
    assert "range_10_m" not in named("fog") and "target" not in named("cross_sensor")
    assert parameters_of("clean", 3) == () and parameters_of("spray", 3, "paper") == ()


def test_a_change_back_to_the_severitys_value_is_none() -> None:
    known = parameters_of("fog", 3)
    own = named("fog")["patchiness"].value
    changes = changed((), "patchiness", 0.1, known)
    changes = changed(changes, "extinction", 0.2, known)
    assert changes == (("extinction", 0.2), ("patchiness", 0.1))
    assert changed(changes, "patchiness", own, known) == (("extinction", 0.2),)


@pytest.mark.parametrize(
    ("kind", "text", "change"),
    [
        ("fog", "extinction:0.05", ("extinction", 0.05)),
        ("beam_missing", "rings_of_64:7", ("rings_of_64", 7)),
        ("noise", "how:impulse", ("how", "impulse")),
    ],
)
def test_changes_are_read_back(
    kind: str, text: str, change: tuple[str, float] | tuple[str, int] | tuple[str, str]
) -> None:
    assert parse_change(text, parameters_of(kind, 3), "link") == change


@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        ("fog", "extinktion:1", "parameters: expected extinction, backscatter, patchiness, found extinktion"),
        ("fog", "extinction:dense", "extinction: expected a number, found dense"),
        ("beam_missing", "rings_of_64:1.5", "rings_of_64: expected a whole number, found 1.5"),
        ("noise", "how:loud", "how: expected gaussian, uniform, impulse, found loud"),
        ("clean", "share:1", "parameters: expected none, found share"),
    ],
)
def test_what_is_no_change_is_named(kind: str, text: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        parse_change(text, parameters_of(kind, 3), "link")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ((("extinction", -1.0),), "extinction: expected 0 to"),
        ((("extinction", "dense"),), "extinction"),
        ((("visibility_m", 50.0),), "expected a setting of Fog, found visibility_m"),
    ],
)
def test_settings_that_do_not_exist_are_refused(
    changes: tuple[tuple[str, float]] | tuple[tuple[str, str]], message: str
) -> None:
    with pytest.raises(SettingsError, match=message):
        Condition("fog", 3, settings=changes).resolved()


def test_a_condition_with_changes_is_none_of_the_known_ones() -> None:
    plain, tuned = Condition("fog", 3), Condition.of("fog", 3, settings=(("extinction", 0.1),))
    assert plain != tuned and len({plain, tuned}) == 2
    assert Condition.of("clean", 3, settings=(("extinction", 0.1),)) == Condition()
    assert tuned.label == "fog 3 with extinction 0.1"


def test_parameters_change_the_sweeps(frame: Frame) -> None:
    plain = corrupted_frame(frame, Condition.of("point_dropping", 3), 0, "street")
    none = corrupted_frame(frame, Condition.of("point_dropping", 3, settings=(("share", 0.0),)), 0, "street")
    most = corrupted_frame(frame, Condition.of("point_dropping", 3, settings=(("share", 0.6),)), 0, "street")
    before, kept, left, few = (len(one.agents[0].sweep) for one in (frame, none, plain, most))
    assert before == kept > left > few > 0
