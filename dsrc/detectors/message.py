"""Messages between this package and a detector in a process of its own; drivers' are framed in the same way.

A message is `DSRC`, the length of a header in bytes as a little-endian uint32, the header (JSON, UTF-8), and the bytes
of the arrays that the header lists as [name, kind, shape], one after the other, in C order, little-endian; kinds are
`f4`, `f8`, `i8` and `u1`. Each question gets one answer:

| question | answer |
|---|---|
| `{"type": "hello", "protocol": 1}` | `{"type": "hello", "protocol": 1, "name": TEXT, "range_m": [6 numbers], ...}` |
| `{"type": "detect", "key": TEXT, "agent_ids": [A]}`, arrays `cloud_0` to `cloud_A-1`, `poses` | `{"type": "boxes"}`, \
arrays `boxes`, `score` |
| any | `{"type": "error", "message": TEXT}` |

`cloud_k` (P, 4) f4 x, y, z, m, and intensity in [0, 1] of agent k, the ego first, in the ego LiDAR's frame (x forward,
y left, z up); `poses` (A, 4, 4) f8 of the agents' LiDARs in that frame; `boxes` (N, 7) f4 or f8 x, y, z of the centre,
length, width, height, m, and yaw, rad, in that frame; `score` (N,) f4 or f8 in [0, 1], in any order. `classes` in the
header of an answer, N names of `sim.boxes.CLASSES`, is optional. Hello also takes `max_agents`, `comm_range_m` and
`users`, see `Hello`. Fields that are not known are passed over.
"""

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from dsrc.data.sample import COMM_RANGE_M
from dsrc.ops.anchors import Users

PROTOCOL = 1
MAGIC = b"DSRC"
MOST_HEADER_BYTES = 1 << 20
MOST_ANSWER_BYTES = 1 << 26
"""Largest arrays of an answer: a million boxes."""

_PREFIX = struct.Struct("<4sI")
_Coordinate = Annotated[float, Meta(ge=-1e4, le=1e4)]
_Length = Annotated[int, Meta(ge=0, le=1 << 40)]
_Shape = Annotated[tuple[_Length, ...], Meta(max_length=4)]
_Array = tuple[Annotated[str, Meta(max_length=100)], Literal["f4", "f8", "i8", "u1"], _Shape]
T = TypeVar("T", bound="Header")


class Header(msgspec.Struct, frozen=True):
    """What every header has.

    Attributes:
        SAID: `type` of headers of a kind.
    """

    SAID: ClassVar[str] = ""

    type: str
    arrays: Annotated[tuple[_Array, ...], Meta(max_length=1000)] = ()


class Hello(Header, frozen=True, kw_only=True):
    """What a detector says of itself.

    Attributes:
        protocol: of its messages.
        name: of detector and weights, part of the keys of its results: other weights need another name.
        range_m: x, y, z minima and maxima of its clouds and of the boxes that count, in the ego LiDAR's frame, m.
        max_agents: most agents whose clouds it gets, the ego included.
        comm_range_m: farthest agent whose cloud it gets, m.
        users: road users that it detects.
    """

    SAID: ClassVar[str] = "hello"

    protocol: Literal[1]
    name: Annotated[str, Meta(min_length=1, max_length=200)]
    range_m: tuple[_Coordinate, _Coordinate, _Coordinate, _Coordinate, _Coordinate, _Coordinate]
    max_agents: Annotated[int, Meta(ge=1, le=100)] = 5
    comm_range_m: Annotated[float, Meta(ge=0.0, le=1e4)] = COMM_RANGE_M
    users: Users = "vehicles"


class Found(Header, frozen=True, kw_only=True):
    """Header of detections.

    Attributes:
        classes: of the boxes; empty for those of the road users that are detected.
    """

    SAID: ClassVar[str] = "boxes"

    classes: Annotated[tuple[str, ...], Meta(max_length=10_000)] = ()


class Failure(Header, frozen=True, kw_only=True):
    """Header of an error of the other end."""

    SAID: ClassVar[str] = "error"

    message: Annotated[str, Meta(max_length=10_000)] = ""


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """Message as received: the header's bytes and the arrays by name."""

    header: bytes
    arrays: dict[str, NDArray[Any]]

    def read(self, kind: type[T]) -> T:
        """Return the header as one of a kind.

        Raises:
            ValueError: a field is missing or wrong.
        """
        return msgspec.json.decode(self.header, type=kind)


def encode(header: Mapping[str, object], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the bytes of a message; arrays are of float32, float64, int64 or uint8."""
    held = {name: np.ascontiguousarray(array, array.dtype.newbyteorder("<")) for name, array in arrays.items()}
    listed = [(name, array.dtype.str[1:], array.shape) for name, array in held.items()]
    content = msgspec.json.encode({**header, "arrays": listed})
    return b"".join([_PREFIX.pack(MAGIC, len(content)), content, *(array.tobytes() for array in held.values())])


def decode(read: Callable[[int], bytes]) -> Message:
    """Read one message.

    Args:
        read: returns exactly so many bytes, or raises.

    Raises:
        ValueError: it is none, or larger than an answer may be; one line says what is there instead.
    """
    start = read(_PREFIX.size)
    magic, length = _PREFIX.unpack(start)
    if magic != MAGIC:
        raise ValueError(f"expected a message that begins with {MAGIC.decode()}, found {start!r}")
    if length > MOST_HEADER_BYTES:
        raise ValueError(f"header: expected at most {MOST_HEADER_BYTES} bytes, found {length}")
    header = read(length)
    try:
        listed = msgspec.json.decode(header, type=Header).arrays
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"header: {error}") from None
    sizes = [math.prod(shape) * int(kind[1]) for _, kind, shape in listed]
    if sum(sizes) > MOST_ANSWER_BYTES:
        raise ValueError(f"arrays: expected at most {MOST_ANSWER_BYTES} bytes, found {sum(sizes)}")
    arrays: dict[str, NDArray[Any]] = {}
    for (name, kind, shape), size in zip(listed, sizes, strict=True):
        if name in arrays:
            raise ValueError(f"arrays: expected names that differ, found '{name}' twice")
        if 0 in shape and math.prod(max(side, 1) for side in shape) > MOST_ANSWER_BYTES:
            raise ValueError(f"arrays: {name}: expected a small empty array, found {shape}")
        arrays[name] = np.frombuffer(read(size), f"<{kind}").reshape(shape)
    return Message(header, arrays)
