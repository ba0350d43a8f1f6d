from pathlib import Path

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
        ("a: 1\nb: !!python/tuple [1]", "line 2: expected plain values, found a tag"),
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
