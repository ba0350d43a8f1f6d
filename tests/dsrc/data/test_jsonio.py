import os
from pathlib import Path

import msgspec
import pytest

from dsrc.data.jsonio import encode_json, read_json
from sim.errors import DataError
from sim.files import write_file
from sim.reading import LARGEST_BYTES


class Thing(msgspec.Struct):
    name: str
    sizes: list[float] = []


def test_what_is_written_reads_back(tmp_path: Path) -> None:
    write_file(tmp_path / "new" / "a.json", encode_json([Thing("a", [0.1, 2.0])]))
    assert read_json(tmp_path / "new" / "a.json", list[Thing]) == [Thing("a", [0.1, 2.0])]
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.json"]


def test_numbers_may_be_text_and_unknown_names_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"name": "a", "sizes": ["1.5", 2], "color": "red"}')
    assert read_json(tmp_path / "a.json", Thing) == Thing("a", [1.5, 2.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not a readable JSON file"),
        ('{"name": 1}', "name: expected str, found int"),
        ('{"name": "a", "sizes": [1, "x"]}', "sizes[1]: expected float, found str"),
        ("{}", "name: expected a value, found nothing"),
        ("[1]", "content: expected object, found array"),
        ('{"name": "a", "sizes": [NaN]}', "not a readable JSON file"),
    ],
)
def test_a_wrong_value_is_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(DataError) as caught:
        read_json(tmp_path / "a.json", Thing)
    assert str(caught.value).startswith(f"{tmp_path / 'a.json'}: {message}") and "\n" not in str(caught.value)


def test_an_absurd_file_and_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").touch()
    os.truncate(tmp_path / "a.json", 1 << 40)  # a hole, which takes no disk
    with pytest.raises(DataError, match=f"expected at most {LARGEST_BYTES} bytes, found {1 << 40} bytes"):
        read_json(tmp_path / "a.json", Thing)
    with pytest.raises(DataError, match="file not found"):
        read_json(tmp_path / "b.json", Thing)
    with pytest.raises(DataError):
        read_json(tmp_path, Thing)


@pytest.mark.parametrize("value", [float("nan"), [{"a": float("inf")}], Thing("a", [float("-inf")])])
def test_what_is_no_number_is_never_written(value: object) -> None:
    with pytest.raises(ValueError, match="not finite"):
        encode_json(value)
    assert encode_json({"a": None, "b": [None, 1.0]}) == b'{"a":null,"b":[null,1.0]}\n'
