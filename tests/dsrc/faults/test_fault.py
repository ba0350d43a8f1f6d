"""Faults as text: what is read is what is written, and what is wrong is told in one line."""

import msgspec
import pytest

from dsrc.faults.fault import Fault, faults_text, parse_faults, require_apart
from dsrc.faults.kinds import CORRUPTION, KINDS, kind_names
from sensors.corruptions import CORRUPTIONS, Condition
from sim.errors import SettingsError


@pytest.mark.parametrize(
    "text",
    [
        "fog:3",
        "fog:5 from 4 s to 9 s on helpers",
        "snow:1 to 0.5 s on 1003,-1",
        "loss:0.3 from 2.5 s",
        "fog:2 on ego + fog:4 on helpers + loss:1 + delay:0.25 on 1003",
    ],
)
def test_what_is_read_is_written_again(text: str) -> None:
    assert faults_text(parse_faults(text)) == text
    assert parse_faults(faults_text(parse_faults(text))) == parse_faults(text)


def test_one_fault_has_one_text_however_it_is_spelled() -> None:
    for text in ("fog", "fog:severity=3", "fog:3 on all", "fog:3 from 0 s", "fog:3   from 0   on all"):
        assert faults_text(parse_faults(text)) == "fog:3", text
    assert parse_faults("fog:3 on ego from 4 to 9s") == parse_faults("fog:3 from 4 s to 9 s on ego")


def test_a_share_may_be_in_percent() -> None:
    assert parse_faults("loss:30% + dirt:80%,growth_s=0") == parse_faults("loss:0.3 + dirt:0.8,growth_s=0")
    for text in ("loss:130%", "loss:%", "brake_gain:50%", "fog:3%"):
        with pytest.raises(SettingsError, match="expected"):
            parse_faults(text)


def test_a_corruption_is_a_fault_all_the_time() -> None:
    (fault,) = parse_faults("fog:2 on helpers")
    assert fault.always and fault.condition == Condition("fog", 2, agents="helpers")
    assert Fault.of(fault.condition) == fault


def test_every_kind_has_a_text() -> None:
    assert set(kind_names()) == {*CORRUPTIONS, *KINDS}
    for name in kind_names():
        fields = KINDS.get(name, CORRUPTION).settings.__struct_fields__
        text = f"{name}:1" if name in CORRUPTIONS else f"{name}:0.5" if fields else name
        (fault,) = parse_faults(text)
        assert fault.kind == name and fault.text == text and fault.always


def test_it_is_there_from_its_begin_until_before_its_end() -> None:
    (fault,) = parse_faults("fog:3 from 0.4 s to 0.9 s on 7")
    there = [step for step in range(12) if fault.at(0.1 * step)]
    assert there == [4, 5, 6, 7, 8]
    assert not fault.always and fault.on(7, 7) and fault.on(7, 1) and not fault.on(1, 1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("fgo:3", "fault 'fgo:3': expected a kind of fault, found fgo; did you mean 'fog'?"),
        ("", "fault '': expected a kind of fault, found none"),
        ("fog:9", "fault 'fog:9', severity: expected a whole number, 1 to 5, found 9"),
        ("fog:2.5", "fault 'fog:2.5', severity: expected a whole number, 1 to 5, found 2.5"),
        ("fog:3+rain:2", "fault 'fog:3+rain:2': expected ' + ' with spaces between two faults"),
        ("fog:3 on", "fault 'fog:3 on': expected agents after 'on', found nothing"),
        ("fog:3 from", "fault 'fog:3 from': expected seconds after 'from', found nothing"),
        ("fog:thick", "fault 'fog:thick', severity: expected a whole number, 1 to 5, found thick"),
        ("loss", "fault 'loss', share: expected 0 to 1, found none"),
        ("loss:nan", "fault 'loss:nan', share: expected 0 to 1, found nan"),
        ("delay:-1", "fault 'delay:-1', seconds: expected a number >= 0, found -1"),
        ("delay:inf", "fault 'delay:inf', seconds: expected a number >= 0, found inf"),
        ("loss:0.3,mean_s=1", "expected share, found mean_s=1"),
        ("fog:3 from 9 s to 4 s", "expected an end after 9 s, found 4 s"),
        ("fog:3 from -1 s", "expected seconds >= 0 after 'from', found -1 s"),
        ("fog:3 from soon", "expected seconds >= 0 after 'from', found soon"),
        ("fog:3 from 1 s from 2 s", "expected from, to or for, and on once each"),
        (
            "fog:3 on moon",
            "roadside or ids of agents, such as 1003,-1, after 'on', found moon",
        ),
        ("loss:0.3 on ego", "expected helpers, vehicles, roadside or ids after 'on', found ego"),
        ("pose_error:3 on ego", "expected helpers, as it is an error relative to the ego, found ego"),
        ("fog:3 + fog:2 for 5 s", "fault 'fog:2 for 5 s': expected one fault of the kind 'fog'"),
        ("fog:3 + fog:2", "fault 'fog:2': expected one fault of the kind 'fog' at a time on an agent, found 'fog:3'"),
    ],
)
def test_a_wrong_fault_is_told_in_one_line(text: str, said: str) -> None:
    with pytest.raises(SettingsError) as error:
        parse_faults(text, "plan.toml")
    assert said in str(error.value) and str(error.value).startswith("plan.toml: fault '")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "apart"),
    [
        ("fog:3 to 4 s + fog:2 from 4 s", True),
        ("fog:3 to 5 s + fog:2 from 4 s", False),
        ("fog:3 on ego + fog:2 on helpers", True),
        ("fog:3 on all + fog:2 on helpers", False),
        ("fog:3 on 1003 + fog:2 on 1004", True),
        ("fog:3 on 1003,1004 + fog:2 on 1004", False),
        ("fog:3 on 1003 + fog:2 on helpers", False),
        ("fog:3 + snow:3", True),
        ("fog:3 on roadside + fog:2 on vehicles", True),
        ("fog:3 on roadside + fog:2 on ego", True),
        ("fog:3 on roadside + fog:2 on helpers", False),
        ("fog:3 on vehicles + fog:2 on ego", False),
        ("fog:3 on roadside + fog:2 on -1", False),
        ("fog:3 on roadside + fog:2 on 1003", True),
    ],
)
def test_a_fault_may_not_overlap_itself(text: str, apart: bool) -> None:
    if apart:
        assert len(parse_faults(text)) == 2
    else:
        with pytest.raises(SettingsError, match="one fault of the kind 'fog' at a time on an agent"):
            parse_faults(text)


def test_an_id_is_the_egos_once_it_is_known() -> None:
    faults = parse_faults("fog:3 on 1000 + fog:2 on ego")
    require_apart(faults, "drive", ego_id=1001)
    with pytest.raises(SettingsError, match="one fault of the kind 'fog'"):
        require_apart(faults, "drive", ego_id=1000)


def test_any_number_of_a_pose_is_enough_for_its_error_and_none_is_too_few() -> None:
    for text in ("misalignment:pitch_deg=2", "localisation_bias:turn_deg=5", "localisation_drift:aside_mps=0.1"):
        (fault,) = parse_faults(text)
        assert next(iter(msgspec.structs.asdict(fault.settings).values())) == 0.0
        with pytest.raises(SettingsError, match="one of"):
            parse_faults(text.partition(":")[0])
