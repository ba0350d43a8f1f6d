"""Error model of a perception: a JSON of rates and spreads, readable and checked.

Every number says how many observations it is made of and which objects they are of: where a corner was not observed
often enough, the numbers are those of a wider group, and `of` names it.
"""

from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from dsrc.closed_loop.perception.error_model.sight import BANDS, KINDS, SIGHTS, Kind, Sight
from sensors.corruptions import CLEAN, EVERYONE, Condition, Family
from sim.boxes import CLASSES
from sim.errors import DataError, SettingsError, complaint
from sim.files import write_file
from sim.radio import IDEAL
from sim.reading import read_bytes

Format = Literal["dsrc error model 4"]
FORMAT: Format = "dsrc error model 4"
QUANTILES = tuple(k / 10 for k in range(11))
"""Shares of the scores below those of `BoxErrors.score`."""
PARTS = ("along", "across", "up", "length", "width", "height", "yaw", "score")
"""Parts of a detection's error: of the centre in the object's frame, m; log ratios of the sizes; yaw, rad; score."""
_LARGEST_BYTES = 1 << 24

Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Count = Annotated[int, Meta(ge=0)]
_Bounded = Annotated[float, Meta(ge=-1e3, le=1e3)]
_Spread = Annotated[float, Meta(ge=0.0, le=1e3)]
_Size = Annotated[float, Meta(gt=0.0, le=1e3)]
Wider = Literal[
    "cell", "kind, sight and heading", "kind and sight", "kind and sight, whatever came before", "sight", "all"
]
"""Group of the observations of a number: its own cell, or the least wide group with enough of them."""


class Chance(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Chance of an event, with its Wilson interval.

    Attributes:
        p: share of the trials with the event.
        low, high: interval at 95 %.
        trials: number of them.
        of: group of objects that they are of.
    """

    p: Share
    low: Share
    high: Share
    trials: Count
    of: Wider = "cell"


class Chain(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Markov chain of an event in consecutive percepts, object by object.

    Attributes:
        first: chance at the first percept.
        not_yet: chance after percepts that all were without it.
        after_yes: chance after a percept with it.
        after_no: chance after one without, when there was one with it before.
    """

    first: Chance
    not_yet: Chance
    after_yes: Chance
    after_no: Chance

    def at(self, before: bool | None, ever: bool, intervals: float) -> float:
        """Return the chance of the event.

        The chain in continuous time that has these chances: its correlation is raised to the power of the time.

        Args:
            before: whether the event was there the last time; None at the first percept.
            ever: whether it was there at any time before.
            intervals: time since the last time over the interval of the fit.
        """
        if before is None:
            return self.first.p
        if not ever:
            return 1.0 - (1.0 - self.not_yet.p) ** intervals
        yes, no = self.after_yes.p, self.after_no.p
        if intervals == 1.0 or no == yes:
            return yes if before else no
        kept = max(yes - no, 0.0) ** intervals
        rate = no / (1.0 - yes + no) if no < 1.0 + no - yes else 1.0
        return rate + (1.0 - rate) * kept if before else rate * (1.0 - kept)


class BoxErrors(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Errors and scores of the boxes that were found.

    Attributes:
        bias: mean of each of `PARTS` but the score.
        sd: standard deviation of each.
        score: at `QUANTILES`.
        boxes: number of them.
        of: group of objects that they are of.
    """

    bias: tuple[_Bounded, _Bounded, _Bounded, _Bounded, _Bounded, _Bounded, _Bounded]
    sd: tuple[_Spread, _Spread, _Spread, _Spread, _Spread, _Spread, _Spread]
    score: Annotated[tuple[Share, ...], Meta(min_length=11, max_length=11)]
    boxes: Count
    of: Wider = "cell"


class Cell(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Objects of one kind, sight, heading and distance.

    Attributes:
        kind: of road user.
        sight: who sees it.
        across: whether it lies across the ego's heading.
        range_m: distances from the ego, m.
        found: whether an object is found, in time.
        errors: of its box.
    """

    kind: Kind
    sight: Sight
    across: bool
    range_m: tuple[float, float]
    found: Chain
    errors: BoxErrors


class Ghosts(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Boxes where nothing is.

    Attributes:
        born: new ones per percept, mean.
        lives: chance that one is there in the next percept, at the same place of the world.
        percepts: number of percepts.
        examples: x and y, m, and yaw, rad, in the ego's frame, length, width and height, m, and score of some of them.
    """

    born: Annotated[float, Meta(ge=0.0, le=1e3)]
    lives: Chance
    percepts: Count
    examples: tuple[tuple[_Bounded, _Bounded, _Bounded, _Size, _Size, _Size, Share], ...]


class Doubles(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Second boxes of objects that were found.

    Attributes:
        there: whether there is one, in time: of objects along the ego's heading, and of those across it.
        examples: errors of `PARTS` but the score, in the object's frame, and score of some of them.
    """

    there: tuple[Chain, Chain]
    examples: tuple[tuple[_Bounded, _Bounded, _Bounded, _Bounded, _Bounded, _Bounded, _Bounded, Share], ...]


class Errors(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Errors of a perception under one condition.

    Attributes:
        corruption: kind, or `clean`.
        severity: 1 to 5; 0 for clean.
        family: of the corruption's settings.
        who: agents whose sensors are corrupted.
        channel: name of the radio channel.
        episodes: recordings of the fit.
        area_m: where boxes were found, x and y of the low and of the high corner in the ego's frame, m.
        cells: each kind, sight, heading and range once.
        flipped: whether a box points backwards, in time: of objects that head as the ego does, to its left, against it
            and to its right. A network without a head for it tells the line that an object lies on, not the direction.
        crossed: whether a box lies across its object, in time: of objects along the ego's heading, and of those across
            it.
        correlation: of each of `PARTS` in consecutive percepts; the score's of its normal quantile.
        doubles: second boxes of what was found.
        ghosts: boxes where nothing is.
    """

    corruption: str = CLEAN
    severity: Annotated[int, Meta(ge=0, le=5)] = 0
    family: Family = "physical"
    who: str = EVERYONE
    channel: str = IDEAL
    episodes: Count
    area_m: tuple[_Bounded, _Bounded, _Bounded, _Bounded]
    cells: tuple[Cell, ...]
    flipped: tuple[Chain, Chain, Chain, Chain]
    crossed: tuple[Chain, Chain]
    correlation: Annotated[tuple[Share, ...], Meta(min_length=len(PARTS), max_length=len(PARTS))]
    doubles: Doubles
    ghosts: Ghosts

    @property
    def condition(self) -> Condition:
        """Condition of the sweeps."""
        return Condition.of(self.corruption, self.severity, self.family, self.who)


class ErrorModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Errors of a perception, by condition.

    Attributes:
        format: `FORMAT`.
        perception: name of the perception that was recorded.
        detector: SHA-256 of its detector; "" without one.
        cooperative: whether it has helpers.
        interval_s: time between percepts, s.
        classes: road users that it finds.
        scenarios: of the recordings.
        conditions: of the recordings.
    """

    format: Format = FORMAT
    perception: str
    detector: str = ""
    cooperative: bool
    interval_s: Annotated[float, Meta(gt=0.0, le=1e3)]
    classes: tuple[str, ...]
    scenarios: tuple[str, ...] = ()
    conditions: Annotated[tuple[Errors, ...], Meta(min_length=1)]

    def errors(self, where: Path | str, condition: Condition, channel: str) -> Errors:
        """Return the errors under a condition.

        The channel of a perception without helpers does not matter.

        Args:
            where: file of the model, for the message.
            channel: name of the radio channel.

        Raises:
            SettingsError: the model was not fitted under it.
        """
        for one in self.conditions:
            if one.condition == condition and (one.channel == channel or not self.cooperative):
                return one
        known = "; ".join(f"{one.condition.label} by channel {one.channel}" for one in self.conditions)
        found = f"{condition.label} by channel {channel}"
        raise SettingsError(complaint(where, "conditions", f"one of {known}", found))


def write_model(path: Path, model: ErrorModel) -> None:
    """Write a model as JSON, atomically; equal models give equal bytes."""
    write_file(path, msgspec.json.format(msgspec.json.encode(model), indent=1) + b"\n")


def read_model(path: Path) -> ErrorModel:
    """Read a model.

    Raises:
        DataError: the file is missing, no error model, or a cell is missing or there twice; one line names the field.
    """
    content = read_bytes(path, "error model", most=_LARGEST_BYTES)
    try:
        model = msgspec.json.decode(content, type=ErrorModel)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        other = b'"dsrc error model' in content and FORMAT.encode() not in content
        hint = "; another version made it: run dsrc model fit again" if other else ""
        raise DataError(complaint(path, "error model", "the JSON of dsrc model fit", str(error), hint)) from None
    unknown = [name for name in model.classes if name not in CLASSES]
    if unknown:
        raise DataError(complaint(path, "classes", f"some of {', '.join(CLASSES)}", unknown[0]))
    wanted = sorted(product(KINDS, SIGHTS, (False, True), BANDS))
    for row, errors in enumerate(model.conditions):
        if sorted((cell.kind, cell.sight, cell.across, cell.range_m) for cell in errors.cells) != wanted:
            expected = f"each kind, sight, heading and range once, {len(wanted)} in all"
            raise DataError(complaint(path, f"conditions[{row}].cells", expected, f"{len(errors.cells)} cells"))
        if errors.ghosts.born > 0.0 and not errors.ghosts.examples:
            raise DataError(complaint(path, f"conditions[{row}].ghosts.examples", "at least one", "none"))
        if (
            any(chain.first.p + chain.after_no.p > 0.0 for chain in errors.doubles.there)
            and not errors.doubles.examples
        ):
            raise DataError(complaint(path, f"conditions[{row}].doubles.examples", "at least one", "none"))
        if any(sorted(cell.errors.score) != list(cell.errors.score) for cell in errors.cells):
            raise DataError(complaint(path, f"conditions[{row}].cells.errors.score", "ascending numbers", "others"))
    return model
