"""Settings of a campaign, a TOML: scenarios x perceptions x corruptions x severities x channels x seeds.

    name = "which corruption kills"
    scenarios = ["ima_building", "ped_dartout"]
    corruption = ["paper_six"]        # clean episodes are always driven
    severity = [3]
    channel = ["ideal"]
    clean_seeds = 20                  # episodes of a cell of the tables, the same seeds for everybody
    seeds = 10

    [[perceptions]]
    name = "truth"

    [[perceptions]]
    name = "ego alone"
    uses = "ego"
    checkpoint = "runs/dsrc_s0/student/detector.pt"

Paths are relative to the file, or else to the current folder.
"""

import logging
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from dsrc.closed_loop.loop import LoopSettings
from dsrc.closed_loop.perception.error_model.model import read_model
from dsrc.closed_loop.perception.open import ALONE, MODELLED, WITHOUT_SENSOR
from dsrc.detectors.texts import SHIPPED_DETECTOR
from dsrc.faults.condition import Disturbance, settled
from dsrc.faults.fault import parse_faults
from dsrc.messages.defences import Defence, parse_defence
from dsrc.options.detection import AutoEngine
from dsrc.options.fields import changed_radios
from dsrc.options.told import NO_DEFENCE
from sensors.corruptions import EVERYONE, PAPER_TABLE, Condition, Family, conditions_of
from sim.radio import IDEAL

LOG = logging.getLogger(__name__)
OF_RADIO = ("channel", "loss", "delay_s", "pose_error")
"""Fields of a campaign that say how messages arrive."""

Seeds = (
    Annotated[int, Meta(ge=1, le=1_000_000)]
    | Annotated[tuple[Annotated[int, Meta(ge=0, le=2**63 - 1)], ...], Meta(min_length=1)]
)
_Names = Annotated[tuple[str, ...], Meta(min_length=1)]


class PerceptionSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Perception of a campaign, a line of its tables.

    Attributes:
        name: in tables.
        uses: `truth`, `sight` (truth in the ego's line of sight), `team-sight` (in any agent's), `ego` (detector
            without helpers), `team` (detector with helpers), `late` (their detections joined), `model` (errors of a
            detector, from the JSON of `dsrc model fit`), or `module:Class` of one's own; "": the name.
        checkpoint: detector file, or the JSON of `model`; "": the shipped detector.
        driver: of these episodes, as that of the campaign; "": that one.
    """

    name: str
    uses: str = ""
    checkpoint: str = ""
    driver: str = ""

    @property
    def kind(self) -> str:
        """What it uses."""
        return self.uses or self.name

    @property
    def has_detector(self) -> bool:
        """Whether it finds road users in sweeps."""
        return self.kind not in (*WITHOUT_SENSOR, MODELLED)

    @property
    def has_file(self) -> bool:
        """Whether it runs the network of a detector file."""
        return self.has_detector and ":" not in self.kind

    @property
    def has_helpers(self) -> bool:
        """Whether it hears others than the ego."""
        if self.kind == MODELLED:
            return read_model(Path(self.checkpoint)).cooperative
        return self.kind not in (*WITHOUT_SENSOR, ALONE)


class Campaign(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of a campaign.

    Attributes:
        scenarios: names or paths.
        perceptions: lines of the tables, in their order.
        name: of the campaign.
        corruption: kinds, `paper_six`, `all` or `clean`; clean episodes are always driven.
        severity: of each corruption, 1 to 5.
        family: of the corruptions' settings.
        corrupted_agents: agents whose sensors are corrupted: `ego`, `helpers`, `all`, or ids such as `1002,-1`.
        channel: radio channels of perceptions with helpers.
        loss: share of packets lost, in place of the channels' own.
        delay_s: delay of messages, s, likewise.
        pose_error: pose error of the helpers, m and deg, likewise.
        fault: faults, each text a row of the tables, see `dsrc.faults.fault`: `fog:3 from 4 s on helpers + loss:0.3`.
        defence: defences against helpers that lie, each text in episodes of its own: names between commas, or `none`;
            perceptions whose helpers tell no boxes are driven without. See `dsrc.messages.defences`.
        clean_seeds: seeds of each scenario and perception without a corruption: a number of them, from 0, or a list.
        seeds: those of each scenario, perception, corruption, severity or fault, and channel; the same for all.
        engine: execution of the networks, see `dsrc.models.storage.deploy.ENGINES`; `auto` becomes the fastest that
            serves all detectors of the campaign, see `with_engine`.
        driver: `planning`, `anticipating` what it cannot see, `evading` by steering too, `careful` for the reference
            driver of UN R157, or one's own, `module:Class` or `tcp://localhost:PORT`, see
            `dsrc.closed_loop.driving.open`.
        loop: intervals and limits of time.
        controls: drive the controls of encounters with the truth first, and refuse to continue where one fails.
        careful: drive the reference driver of UN R157 with the truth too: crashes that it avoids are avoidable.
    """

    scenarios: _Names
    perceptions: Annotated[tuple[PerceptionSpec, ...], Meta(min_length=1)]
    name: str = "campaign"
    corruption: tuple[str, ...] = (PAPER_TABLE,)
    severity: Annotated[tuple[Annotated[int, Meta(ge=1, le=5)], ...], Meta(min_length=1)] = (3,)
    family: Family = "physical"
    corrupted_agents: str = EVERYONE
    channel: _Names = (IDEAL,)
    loss: float | None = None
    delay_s: float | None = None
    pose_error: float | None = None
    fault: tuple[str, ...] = ()
    defence: tuple[str, ...] = ()
    clean_seeds: Seeds = 20
    seeds: Seeds = 10
    engine: AutoEngine = "auto"
    driver: str = "planning"
    loop: LoopSettings = LoopSettings()
    controls: bool = True
    careful: bool = True

    @property
    def drivers(self) -> tuple[str, ...]:
        """Drivers of the perceptions, each once."""
        return tuple(dict.fromkeys(one.driver or self.driver for one in self.perceptions))

    @property
    def all_seeds(self) -> tuple[int, ...]:
        """Seeds of clean and other episodes, each once."""
        return tuple(dict.fromkeys([*listed(self.clean_seeds), *listed(self.seeds)]))

    @property
    def conditions(self) -> list[Condition]:
        """Clean, then every corruption at every severity."""
        return conditions_of(self.corruption, self.severity, (self.family,), self.corrupted_agents, "campaign")

    @property
    def radios(self) -> tuple[str, ...]:
        """Radio channels with their changes."""
        return changed_radios(self.channel, self.loss, self.delay_s, self.pose_error)

    @property
    def defences(self) -> tuple[Defence, ...]:
        """Defences, each in episodes of its own."""
        return tuple(parse_defence(text, "campaign") for text in self.defence or (NO_DEFENCE,))

    @property
    def lies(self) -> bool:
        """Whether it has attacks or defences, so that what helpers told is measured."""
        return any(self.defences) or any(one.attack for text in self.fault for one in parse_faults(text, "campaign"))

    def disturbed(self, channel: str) -> list[Disturbance]:
        """Return what the episodes of a channel are driven in: clean, each corruption, each text of faults."""
        own = [Disturbance(condition, channel) for condition in self.conditions]
        return [*own, *(settled(parse_faults(text, "campaign"), channel) for text in self.fault)]


def listed(seeds: int | tuple[int, ...]) -> tuple[int, ...]:
    """Return the seeds that a number of them, or a list, stands for."""
    return tuple(range(seeds)) if isinstance(seeds, int) else seeds


def with_engine(plan: Campaign) -> Campaign:
    """Return a campaign whose engine is no longer `auto`: one for all its detectors, so that they compare.

    It is `bf16` where the processor computes it and all detector files are as good in it, else `fused`.
    """
    if plan.engine != "auto":
        return plan
    paths = {Path(one.checkpoint or SHIPPED_DETECTOR) for one in plan.perceptions if one.has_file}
    if not paths:
        return replace(plan, engine="fused")
    from dsrc.models.storage.deploy import engine_for  # torch takes seconds to import

    found = {engine_for(path) for path in sorted(paths)}
    if len(found) > 1:
        LOG.info("engine fused for all detectors of the campaign, so that they compare")
    return replace(plan, engine=found.pop() if len(found) == 1 else "fused")
