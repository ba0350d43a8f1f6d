"""Search for the critical severity, delay or loss of an episode: where its outcome flips.

What is varied is that of the fault which has it, at its time and on its agents, beside the other faults of the text;
else that of the corruption, or of the channel.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from msgspec.structs import replace

from dsrc.closed_loop.campaign.critical import CriticalValue, critical_value
from dsrc.closed_loop.campaign.plan import Campaign, PerceptionSpec, with_engine
from dsrc.closed_loop.driving.open import open_driver
from dsrc.closed_loop.loop import ClosedLoop
from dsrc.closed_loop.perception.open import ALONE, WITHOUT_SENSOR, open_perception
from dsrc.closed_loop.types import Outcome, Perception
from dsrc.faults.condition import Disturbance, settled
from dsrc.faults.fault import Fault, Faults, parse_faults
from dsrc.faults.kinds import Severity
from dsrc.tables.table import Column, Table, TableRow
from sensors.corruptions import CLEAN, SEVERITIES, Condition
from sim.errors import SettingsError, complaint, option
from sim.radio import Radio

Quantity = Literal["severity", "delay_s", "loss"]

LONGEST_DELAY_S = 1.0
_FINE = (Outcome.ARRIVED, Outcome.TIMEOUT, Outcome.DESYNCHRONISED)
"""Outcomes that are no failure; who never met the encounter did not fail in it."""
_LOSS_TOLERANCE = 0.02
_KINDS = {"delay_s": "delay", "loss": "loss"}
"""Kinds of faults of the quantities that a channel has, too."""
_TITLES = {"severity": "severity", "delay_s": "delay s", "loss": "lost packets"}


@dataclass(frozen=True, slots=True)
class Search:
    """Result of a search.

    Attributes:
        plan: the episode.
        quantity: that was varied.
        value: where its outcome flips.
        outcomes: of the episode by value.
    """

    plan: Campaign
    quantity: Quantity
    value: CriticalValue
    outcomes: dict[float, Outcome]


def search(plan: Campaign, quantity: Quantity, progress: Callable[[int, int], None] | None = None) -> Search:
    """Return where the outcome of one episode flips along a quantity.

    Severities are those from clean to 5. Delays of the helpers' messages go to `LONGEST_DELAY_S`, to the interval of
    detections: messages are sent then. Losses go to 1, to a share of 0.02 of the packets, the same ones at a larger
    share and more.

    Args:
        plan: of one scenario, perception, seed, channel and text of faults, and for a severity one corruption, in that
            text or beside it.
        quantity: `severity`, `delay_s` or `loss`.
        progress: called with episodes done, and that number and one more.

    Raises:
        SettingsError: the plan has more episodes than one, or none that the quantity changes.
    """
    plan = with_engine(plan)
    faults = parse_faults(plan.fault[0]) if plan.fault else ()
    kind = _corruption(plan, faults, quantity)
    one, seed = _single(plan, kind, quantity)
    outcomes: dict[float, Outcome] = {}
    driver = open_driver(one.driver or plan.driver, plan.loop.perception_limit_s)

    def fine(value: float) -> bool:
        perception = _perception(plan, one, _at(plan, kind, faults, quantity, value))
        loop = ClosedLoop(plan.scenarios[0], perception, driver, plan.loop)
        outcomes[value] = loop.run(seed)
        if progress is not None:
            progress(len(outcomes), len(outcomes) + 1)
        return outcomes[value] in _FINE

    step_s = plan.loop.detect_every_s
    values, tolerance = {
        "severity": ([0.0, *map(float, SEVERITIES)], 1.0),
        "delay_s": (_delays(step_s), step_s),
        "loss": (np.linspace(0.0, 1.0, 5).tolist(), _LOSS_TOLERANCE),
    }[quantity]
    return Search(plan, quantity, critical_value(fine, values, tolerance), dict(sorted(outcomes.items())))


def _delays(step_s: float) -> list[float]:
    """Return the delays to try, s: every second interval of detections, and the longest whole number of them."""
    last = int(LONGEST_DELAY_S / step_s + 1e-9)
    if last < 1:
        expected = f"at most {LONGEST_DELAY_S:g} s, for a critical delay up to that"
        raise SettingsError(complaint("drive", "detect_every_s", expected, f"{step_s:g}"))
    return [number * step_s for number in dict.fromkeys([*range(0, last, 2), last])]


def search_table(found: Search) -> Table:
    """Table of the outcome of every value tried."""
    rows = tuple(TableRow(f"{value:.3g}", (outcome.value,)) for value, outcome in found.outcomes.items())
    return Table("search", "", _TITLES[found.quantity], (Column("outcome", align="left"),), rows)


def search_text(found: Search) -> str:
    """Return where the outcome flips, in one line."""
    plan, flips = found.plan, found.value.flips
    what = f"{plan.scenarios[0]}, {plan.perceptions[0].name}, seed {_seeds(plan)[0]}, {_TITLES[found.quantity]}: "
    if not flips:
        return f"{what}the outcome never flips"
    text = ", ".join(f"{'worse' if one.fails else 'better'} from {one.below:.3g} to {one.above:.3g}" for one in flips)
    return what + text + ("" if found.value.monotone else "; not monotone: more of it also does less harm")


def _seeds(plan: Campaign) -> tuple[int, ...]:
    return tuple(range(plan.clean_seeds)) if isinstance(plan.clean_seeds, int) else plan.clean_seeds


def _varied(faults: Faults, quantity: Quantity) -> list[Fault]:
    """Return the faults that have a quantity."""
    if quantity == "severity":
        return [one for one in faults if isinstance(one.settings, Severity)]
    return [one for one in faults if one.kind == _KINDS[quantity]]


def _corruption(plan: Campaign, faults: Faults, quantity: Quantity) -> str:
    """Return the corruption beside the faults of a plan; raises SettingsError unless one has the quantity."""
    kinds = sorted({one.kind for one in plan.conditions if one.kind != CLEAN})
    having = _varied(faults, quantity)
    if kinds and faults:
        hint = f"; one text says both: --fault '{kinds[0]}:{plan.severity[0]} + {plan.fault[0]}'"
        raise SettingsError(complaint("drive", "--corruption", "none beside --fault", kinds[0], hint))
    if len(having) > 1:
        named = " ".join(one.kind for one in having)
        raise SettingsError(complaint("drive", "--fault", f"one fault with a {_TITLES[quantity]} in the text", named))
    if len(kinds) > 1 or (quantity == "severity" and not kinds and not having):
        raise SettingsError(_one_for(quantity, "corruption", " ".join(kinds) or "none"))
    return kinds[0] if kinds else CLEAN


def _one_for(quantity: Quantity, field: str, found: str) -> str:
    return complaint("drive", option(field), f"one value with --critical {quantity}", found)


def _single(plan: Campaign, kind: str, quantity: Quantity) -> tuple[PerceptionSpec, int]:
    """Return perception and seed of a plan that has one of each; raises SettingsError otherwise."""
    counts = {
        "perception": len(plan.perceptions),
        "seed": len(_seeds(plan)),
        "channel": len(plan.radios),
        "fault": len(plan.fault),
        "defence": len(plan.defence),
        "severity": 1 if kind == CLEAN else len(plan.severity),
    }
    for field, count in counts.items():
        if count > 1:
            raise SettingsError(_one_for(quantity, field, str(count)))
    one = plan.perceptions[0]
    if one.kind in WITHOUT_SENSOR or (one.kind == ALONE and quantity != "severity"):
        needed = "a detector" if quantity == "severity" else "a detector with helpers"
        raise SettingsError(complaint("drive", "--perception", f"{needed} with --critical {quantity}", one.kind))
    return one, _seeds(plan)[0]


def _at(plan: Campaign, kind: str, faults: Faults, quantity: Quantity, value: float) -> Disturbance:
    """Return what the episode is driven in at a value of the quantity."""
    radio = Radio.parse(plan.radios[0])
    if having := _varied(faults, quantity):
        idle = quantity == "severity" and round(value) == 0
        setting = {"severity": round(value)} if quantity == "severity" else {having[0].first: value}
        changed = () if idle else (replace(having[0], settings=replace(having[0].settings, **setting)),)
        place = faults.index(having[0])
        return settled((*faults[:place], *changed, *faults[place + 1 :]), radio.label)
    severity = plan.severity[0]
    if quantity == "severity":
        severity = round(value)
    else:
        radio = radio.changed(**{quantity: value})
    if faults:
        return settled(faults, radio.label)
    condition = Condition.of(kind if severity else CLEAN, severity, plan.family, plan.corrupted_agents)
    return Disturbance(condition, radio.label)


def _perception(plan: Campaign, one: PerceptionSpec, driven_in: Disturbance) -> Perception:
    return open_perception(
        one.kind,
        fault=driven_in.faults,
        defence=plan.defences[0],
        checkpoint=Path(one.checkpoint) if one.checkpoint else None,
        corruption=driven_in.condition,
        channel=driven_in.channel,
        interval_s=plan.loop.detect_every_s,
        look_ahead_s=plan.loop.look_ahead_s,
        engine=plan.engine,
    )
