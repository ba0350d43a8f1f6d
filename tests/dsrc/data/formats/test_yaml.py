from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from dsrc.data.formats.yaml import emit, parse_yaml, read_yaml
from sim.errors import DataError

VALUE = {
    "empty": {},
    "none": [],
    "tiny": 1e-5,
    "huge": -2.5e20,
    "round": 1e22,
    "yes": "no",
    "flag": True,
    "nothing": None,
    7: {"a": [1.0, -2, "x: y", "it's"], "b": {"c": 0.1}, "list of tables": [{"k": 1.5}]},
}


def test_every_yaml_reader_gets_back_what_was_written() -> None:
    text = emit(VALUE)
    assert yaml.load(text, yaml.SafeLoader) == VALUE == yaml.load(text, yaml.CSafeLoader)


@given(st.dictionaries(st.text(max_size=100), st.text(), min_size=1))
def test_any_text_is_read_back_by_every_yaml_reader(value: dict[str, str]) -> None:
    text = emit(value)
    assert yaml.load(text, yaml.SafeLoader) == value == yaml.load(text, yaml.CSafeLoader)


def test_half_of_a_character_becomes_a_mark_that_can_be_read() -> None:
    assert yaml.safe_load(emit({"name": "a\ud83db"})) == {"name": "a\ufffdb"}


def test_an_empty_array_does_not_stand_for_more_values_than_a_file_may_have(tmp_path: Path) -> None:
    text = (
        "a: !!python/object/apply:numpy.core.multiarray._reconstruct\n"
        "  args: [!!python/name:numpy.ndarray '', [0], !!binary Yg==]\n"
        "  state: [1, [100000000, 0], !!python/object/apply:numpy.dtype [f8], false, !!binary '']\n"
    )
    assert parse_yaml(tmp_path / "a.yaml", text.replace("100000000", "3")) == {"a": [[], [], []]}
    with pytest.raises(DataError, match="expected an array of numpy"):
        parse_yaml(tmp_path / "a.yaml", text)


def test_only_plain_finite_values_are_written() -> None:
    for bad in (float("nan"), float("inf"), object()):
        with pytest.raises(ValueError, match="YAML"):
            emit({"a": bad})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: !!python/object/apply:os.system ['touch {marker}']", "line 1: expected plain values, found a tag"),
        ("a: 1\nb: !!python/name:os.system ''", "line 2: expected plain values, found a tag"),
        ("a: !!python/object/apply:numpy.load ['{marker}']", "line 1: expected plain values, found a tag"),
        ("a: !!python/object/apply:numpy.dtype [O8]", "expected numbers of numpy, not of type 'O8'"),
        ("a: !!python/object/apply:numpy._core.multiarray.scalar [1, 2]", "expected numbers of numpy"),
        (
            "a: !!python/object/apply:numpy.core.multiarray.scalar\n"
            "- !!python/object/apply:numpy.dtype [f8]\n- !!binary YQ==",
            "expected 1 numbers of numpy in 1 bytes",
        ),
        ("a: [1", "not YAML"),
        ("- 1", "expected a mapping, found list"),
        ("", "expected a mapping, found NoneType"),
        ("a: \x00", "not YAML"),
    ],
)
def test_a_bad_file_gets_one_line_and_is_never_executed(tmp_path: Path, text: str, message: str) -> None:
    marker = tmp_path / "executed"
    (tmp_path / "a.yaml").write_text(text.replace("{marker}", str(marker)))
    with pytest.raises(DataError) as caught:
        read_yaml(tmp_path / "a.yaml")
    assert message in str(caught.value) and "a.yaml" in str(caught.value) and "\n" not in str(caught.value)
    assert not marker.exists()


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="UTF-8"):
        read_yaml(tmp_path / "a.yaml")


def test_numpys_numbers_and_arrays_are_read_as_plain_ones(tmp_path: Path) -> None:
    value = {
        "matrix": np.arange(12.0).reshape(3, 4),
        "columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "flags": np.array([True, False]),
        "big": np.arange(3, dtype=">i2"),
        "single": np.float32(2.5),
        "empty": np.zeros((0, 4)),
        "pair": (1, "two"),
    }
    (tmp_path / "a.yaml").write_text(yaml.dump(value))
    assert read_yaml(tmp_path / "a.yaml") == {
        "matrix": [[0.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], [8.0, 9.0, 10.0, 11.0]],
        "columns": [[0, 1, 2], [3, 4, 5]],
        "flags": [True, False],
        "big": [0, 1, 2],
        "single": 2.5,
        "empty": [],
        "pair": [1, "two"],
    }


numbers = st.one_of(st.integers(-(10**20), 10**20), st.floats(), st.just(-0.0))
words = st.one_of(
    st.sampled_from(["y", "No", "TRUE", "null", "true", "vehicle.audi.a2", "17,37,103", "1e5", "0123", "1:30", ""]),
    st.text("aeYnoN.,:0_- ", max_size=6),
)
leaves = st.one_of(
    numbers,
    words,
    st.booleans(),
    st.none(),
    st.lists(numbers, max_size=4),
    st.lists(st.lists(numbers, max_size=3), max_size=3),
)
tables = st.recursive(
    st.dictionaries(st.one_of(words, st.integers(-(10**20), 10**20)), leaves, max_size=4),
    lambda inner: st.dictionaries(st.one_of(words, st.integers(0, 2000)), st.one_of(leaves, inner), max_size=4),
    max_leaves=6,
)


@given(tables, st.sampled_from([False, None]), st.sampled_from([2, 4]))
def test_what_pyyaml_lays_out_is_read_as_pyyaml_reads_it(table: dict, flow: bool | None, indent: int) -> None:
    text = yaml.dump(table, default_flow_style=flow, indent=indent)
    assert repr(parse_yaml(Path("a.yaml"), text)) == repr(yaml.load(text, yaml.SafeLoader))


@given(tables, st.data())
def test_damaged_files_are_read_as_pyyaml_reads_them_or_refused(table: dict, data: st.DataObject) -> None:
    text = yaml.dump(table)
    place = data.draw(st.integers(0, len(text)))
    text = (
        text[:place]
        + data.draw(st.sampled_from(["", " ", "\n", "- ", "  ", ":", "\n  ", "#", "1", "\t", "\r\n", "a: 1\n"]))
        + text[place + data.draw(st.integers(0, 3)) :]
    )
    try:
        expected = yaml.load(text, yaml.CSafeLoader)
    except (yaml.YAMLError, ValueError, TypeError):
        expected = None
    if isinstance(expected, dict):
        assert repr(parse_yaml(Path("a.yaml"), text)) == repr(expected)
    else:
        with pytest.raises((DataError, TypeError)):
            parse_yaml(Path("a.yaml"), text)


@pytest.mark.parametrize(
    "text",
    [
        "a: 1\na: 2\n",
        "a:\n  b: 1\nc: 2\n",
        "a:\nb: 1\n",
        "a:\n",
        "a:\n- 1\n- 2\nb:\n  - 3\n",
        "a: 1\n  b: 2\n",
        "a:\n- 1\n- - 2\n",
        "a:\n- - 1\n  - 2\n- 3\n",
        "a:\n    b: 1\n  c: 2\n",
        "a: 1\n\nb: 2\n",
        "a: 1\nb: 2",
        "a: 1\r\nb: 2\r\n",
        "a: True\nb: yes\nNo: 1\ny: 2\n",
        "1: 0x10\n2: 010\n3: 1_000\n4: 1.5e3\n5: 1.5e+3\n6: .5\n7: 1:30\n",
        "a: 2001-01-01\nb: ~\nc:\n- -0.0\n- 1.0e-05\n",
        "a: 1 # one\n",
        "- 1\n",
        "a: b: c\n",
        "a\n",
    ],
)
def test_odd_layouts_are_read_as_pyyaml_reads_them(text: str) -> None:
    try:
        expected = yaml.load(text, yaml.SafeLoader)
    except yaml.YAMLError:
        expected = None
    if isinstance(expected, dict):
        assert repr(parse_yaml(Path("a.yaml"), text)) == repr(expected)
    else:
        with pytest.raises(DataError):
            parse_yaml(Path("a.yaml"), text)


def test_opv2vs_files_do_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    content = {
        "camera0": {"extrinsic": [[1.0, 0.5], [-2.0e-17, 1]], "cords": [1.5, -2.0]},
        "ego_speed": 3.25,
        "lidar_pose": [1.0, 2.0, 3.0, 0.0, -90.0, 0.0],
        "plan_trajectory": [],
        "RSU": True,
        "vehicles": {7: {"angle": [0.0, 1.0, 0.0], "bp_id": "vehicle.audi.a2", "color": "1,2,3"}, 12: {"speed": 0.5}},
    }
    text = yaml.dump(content)
    monkeypatch.setattr(yaml, "load", None)
    assert parse_yaml(Path("a.yaml"), text) == content
