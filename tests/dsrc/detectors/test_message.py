"""Messages between this package and a detector in another process: read back as written, refused in one line."""

import io
import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dsrc.detectors.message import MAGIC, MOST_ANSWER_BYTES, Found, Hello, Message, decode, encode

HELLO = {"type": "hello", "protocol": 1, "name": "x", "range_m": [-1, -1, -1, 1, 1, 1]}


def read(content: bytes) -> Message:
    stream = io.BytesIO(content)

    def exactly(count: int) -> bytes:
        part = stream.read(count)
        if len(part) < count:
            raise EOFError
        return part

    return decode(exactly)


def packed(header: object, rest: bytes = b"") -> bytes:
    content = json.dumps(header).encode()
    return struct.pack("<4sI", MAGIC, len(content)) + content + rest


def test_a_message_is_read_as_it_was_written() -> None:
    arrays = {"boxes": np.arange(14, dtype=np.float32).reshape(2, 7), "ids": np.array([3]), "none": np.zeros((0, 3))}
    message = read(encode({"type": "boxes", "classes": ["car", "bus"]}, arrays))
    assert message.read(Found).classes == ("car", "bus")
    assert {name: array.tolist() for name, array in message.arrays.items()} == {
        name: array.tolist() for name, array in arrays.items()
    }
    assert message.arrays["boxes"].dtype == np.float32 and message.arrays["none"].shape == (0, 3)


def test_fields_of_later_versions_are_passed_over() -> None:
    assert read(packed({**HELLO, "colour": "blue"})).read(Hello).max_agents == 5


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"Loading model...\n", r"begins with DSRC, found b'Loading '"),
        (struct.pack("<4sI", MAGIC, 1 << 30), "header: expected at most"),
        (packed([1]), "header: "),
        (packed({"type": "boxes", "arrays": [["boxes", "O", [1]]]}), "header: Invalid enum value 'O'"),
        (packed({"type": "boxes", "arrays": [["boxes", "f8", [-1]]]}), "header: .*>= 0"),
        (packed({"type": "boxes", "arrays": [["boxes", "f8", [1 << 40, 1 << 40]]]}), "arrays: expected at most"),
        (packed({"type": "boxes", "arrays": [["boxes", "f8", [0, 1 << 40]]]}), "boxes: expected a small empty array"),
        (packed({"type": "boxes", "arrays": [["a", "f4", [1]], ["a", "f4", [1]]]}, b"\0" * 8), "found 'a' twice"),
    ],
)
def test_what_is_no_message_is_told_in_one_line(content: bytes, words: str) -> None:
    with pytest.raises(ValueError, match=words) as raised:
        read(content)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "change",
    [{"protocol": 2}, {"name": ""}, {"range_m": [1]}, {"range_m": [1e9] * 6}, {"max_agents": 0}, {"users": "dogs"}],
)
def test_a_wrong_hello_is_refused(change: dict) -> None:
    with pytest.raises(ValueError):
        read(packed({**HELLO, **change})).read(Hello)


@given(st.data())
def test_any_bytes_are_a_message_or_an_error_of_values(data: st.DataObject) -> None:
    """Bytes of a real message with some replaced, cut or added: nothing else is raised, and nothing large is made."""
    content = bytearray(encode({"type": "boxes"}, {"boxes": np.ones((3, 7), np.float32), "score": np.ones(3)}))
    for _ in range(data.draw(st.integers(0, 6))):
        place = data.draw(st.integers(0, len(content) - 1))
        content[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=4))
    try:
        message = read(bytes(content))
        message.read(Found)
    except (ValueError, EOFError):
        return
    assert sum(array.nbytes for array in message.arrays.values()) <= MOST_ANSWER_BYTES
