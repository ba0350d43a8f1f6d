from pathlib import Path
from typing import Annotated, Literal

import msgspec
import pytest
from msgspec import Meta

from sim.errors import SettingsError
from sim.settings import convert, read_toml


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    share: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.5
    kind: Literal["fog", "snow"] = "fog"

    def __post_init__(self) -> None:
        if self.kind == "snow" and self.share > 0.9:
            raise ValueError("snow has a share of at most 0.9")
        if self.kind == "snow" and self.share < 0.1:
            raise ValueError("share: expected at least 0.1 of snow")


class Whole(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    parts: tuple[Part, ...] = ()
    named: dict[str, Part] = {}
    drawn: float | tuple[float, float] = 0.0
    mode: Annotated[Literal["dry", "wet"], Meta()] | msgspec.UnsetType = msgspec.UNSET
    modes: tuple[Literal["dry", "wet"], ...] = ()
    others: tuple[Part, ...] | msgspec.UnsetType = msgspec.UNSET
    inner: "Whole | None" = None


def test_right_values_are_converted() -> None:
    raw = {"name": "a", "parts": [{"share": 1}], "named": {"x": {"kind": "snow"}}}
    assert convert(raw, Whole, "file", SettingsError) == Whole("a", (Part(1.0),), {"x": Part(kind="snow")})
    assert convert("0.3", float, "file", SettingsError, strict=False) == 0.3


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ({}, "name: expected a value, found nothing"),
        ({"name": 3}, "name: expected str, found 3"),
        ({"name": "a", "parts": 4}, "parts: expected array, found 4"),
        ({"name": "a", "parts": [{}, {"share": 2.0}]}, "parts[1].share: expected float <= 1.0, found 2.0"),
        ({"name": "a", "parts": [{"kind": "hail"}]}, "parts[0].kind: expected one of fog, snow, found hail"),
        ({"name": "a", "named": {"x": {"share": -1}}}, "named.x.share: expected float >= 0.0, found -1"),
        ({"name": "a", "named": {"x": {"kind": "hail"}}}, "named.x.kind: expected one of fog, snow, found hail"),
        ({"name": "a", "parts": [{"kind": "snow", "share": 1.0}]}, "parts[0]: snow has a share of at most 0.9"),
        ({"name": "a", "named": {"x": {"kind": "snow", "share": 0.0}}}, "named.x.share: expected at least 0.1 of snow"),
        ([], "top level: expected object, found []"),
        ({"name": "a", "drawn": "forty"}, "drawn: expected a number, or [low, high], found forty"),
        ({"name": "a", "mode": "damp"}, "mode: expected one of dry, wet, found damp"),
        ({"name": "a", "modes": ["dry", "damp"]}, "modes[1]: expected one of dry, wet, found damp"),
        ({"name": "a", "others": [{"kind": "hail"}]}, "others[0].kind: expected one of fog, snow, found hail"),
        ({"name": "a", "inner": 3}, "inner: expected object, found 3"),
        (
            {"name": "a", "inner": {"name": "b", "named": {"x": {}, "y": {"kind": "hail"}}}},
            "inner.named.y.kind: expected one of fog, snow, found hail",
        ),
    ],
)
def test_a_wrong_value_is_named_with_its_place(raw: object, message: str) -> None:
    with pytest.raises(SettingsError) as caught:
        convert(raw, Whole, "file", SettingsError)
    assert str(caught.value) == f"file: {message}"


def test_a_value_alone_has_the_field_that_it_is_of() -> None:
    with pytest.raises(SettingsError, match=r"^file: methods.DSRC.share: expected float, found a$"):
        convert("a", float, "file", SettingsError, field="methods.DSRC.share")
    with pytest.raises(SettingsError, match=r"^file: top level: expected int, found a{77}\.\.\.$"):
        convert("a" * 10_000, int, "file", SettingsError)


@pytest.mark.parametrize(
    "place", ["parts = [{{}}, {}]", "others = [{{}}, {}]", "inner = {{ name = 'b', parts = [{}] }}"]
)
def test_an_unknown_key_is_answered_with_the_known_ones_however_its_table_is_optional(
    tmp_path: Path, place: str
) -> None:
    (tmp_path / "a.toml").write_text(f"name = 'a'\n{place.format('{ z = 1 }')}\n", encoding="utf-8")
    message = r"a\.toml: [\w.]+\[\d\]: expected known keys only, found key 'z'; one of: kind, share$"
    with pytest.raises(SettingsError, match=message):
        read_toml(tmp_path / "a.toml", Whole, SettingsError)
