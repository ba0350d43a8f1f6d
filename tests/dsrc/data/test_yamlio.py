from pathlib import Path

import numpy as np
import pytest
import yaml

from dsrc.data.yamlio import emit, read_yaml
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


def test_every_yaml_reader_gets_back_what_was_written():
    text = emit(VALUE)
    assert yaml.load(text, yaml.SafeLoader) == VALUE == yaml.load(text, yaml.CSafeLoader)


def test_only_plain_finite_values_are_written():
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
def test_a_bad_file_gets_one_line_and_is_never_executed(tmp_path: Path, text: str, message: str):
    marker = tmp_path / "executed"
    (tmp_path / "a.yaml").write_text(text.replace("{marker}", str(marker)))
    with pytest.raises(DataError) as caught:
        read_yaml(tmp_path / "a.yaml")
    assert message in str(caught.value) and "a.yaml" in str(caught.value) and "\n" not in str(caught.value)
    assert not marker.exists()


def test_bytes_that_are_no_text_are_refused(tmp_path: Path):
    (tmp_path / "a.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="UTF-8"):
        read_yaml(tmp_path / "a.yaml")


def test_numpys_numbers_and_arrays_are_read_as_plain_ones(tmp_path: Path):
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
