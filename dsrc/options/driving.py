"""Options of `dsrc drive`: episodes and campaigns of the closed loop."""

from typing import Annotated

import msgspec
from tyro.conf import Positional, arg

from dsrc.options.detection import AutoEngine
from dsrc.options.fields import CHANNELS, CORRUPTIONS, Family, FaultTexts, File, changed_radios, choice
from dsrc.options.told import BOXES, DEFENCES, MESSAGES, NO_DEFENCE

DRIVERS = ("planning", "anticipating", "evading", "careful", "MODULE:CLASS", "PROCESS")
_TOLD = ("late", *(name for name in MESSAGES if name != BOXES))
PERCEPTIONS = ("truth", "sight", "team-sight", "ego", "team", *_TOLD, "FILE", "MODEL.json", "MODULE:CLASS")


class DriveOptions(msgspec.Struct, frozen=True):
    """Options of closed-loop episodes.

    Attributes:
        what: scenario, TOML of a campaign, or log of an episode to look at again.
        perception: what the ego perceives: the truth, the truth in its line of sight or in any agent's (team-sight),
            its detector alone, the detector with helpers, detections of each agent alone joined (late; cpm: as ETSI's
            Collective Perception Messages; cpm-dynamics, cpm-distance: less what others tell), the detector of a file
            with helpers (ego=FILE: alone, late=FILE: joined),
            an error model (dsrc model fit), or a class of one's own; NAME=PERCEPTION names a line of the table;
            default: truth.
        checkpoint: detector file; default: the shipped one.
        corruption: kinds of corruption, each in episodes of its own; paper_six are those of the paper's tables;
            default: none.
        severity: severities of each corruption, 1 to 5; default: 3.
        family: models of the corruptions: of physical causes, or as published in papers; default: physical.
        corrupted_agents: agents whose sensors are corrupted: ego, helpers, vehicles, roadside, all, or ids such as
            1002,-1; default: all.
        channel: radio channels; default: ideal.
        loss: share of packets lost, 0 to 1, such as 0.3; default: the channel's.
        delay_s: delay of messages, s; default: the channel's.
        pose_error: pose error of the helpers, m and deg; default: the channel's.
        fault: faults, each text in episodes of its own: a corruption with its severity, or what is wrong with a sensor,
            the radio and so on, with its numbers, time and agents, as in 'fog:3 from 4 s to 9 s on helpers'; several at
            once with plus signs between them; default: none.
        defence: defences against helpers that lie (faults ghost, remove, false_pose, replay), each text in episodes of
            its own: one of these, or several between commas; default: none.
        seed: seeds of the episodes, one each; default: 0.
        engine: execution of the network, see dsrc evaluate; auto is bf16 where the processor computes it and the
            detector is as good in it, else fused.
        driver: driver: plans by predicted tracks, also anticipates road users that it cannot see, also steers around
            somebody where braking does not suffice, the careful driver of UN R157, a class of one's own, or a process,
            pipe:COMMAND or tcp://localhost:PORT; default: planning.
        duration_s: longest episode, s; default: 20, for anticipating 30.
        detect_every_s: interval of detections, s; default: 0.1.
        latency_s: time from a measurement to its detections, s; default: 0.
        look_ahead_s: reaction time of the stopping distance that the detector's range is shifted ahead to cover, s, by
            half its reach at most; default: 0, no shift.
    """

    what: Positional[Annotated[str, arg(metavar="SCENARIO|PLAN.toml|EPISODE.npz")]]
    perception: Annotated[tuple[str, ...], choice(PERCEPTIONS, several=True)] = ()
    checkpoint: File | None = None
    corruption: Annotated[tuple[str, ...], choice(("clean", "paper_six", "all", *CORRUPTIONS), several=True)] = ()
    severity: tuple[int, ...] = ()
    family: Family | None = None
    corrupted_agents: str | None = None
    channel: Annotated[tuple[str, ...], choice(CHANNELS, several=True)] = ()
    loss: float | None = None
    delay_s: float | None = None
    pose_error: float | None = None
    fault: FaultTexts = ()
    defence: Annotated[tuple[str, ...], choice((NO_DEFENCE, *DEFENCES), several=True)] = ()
    seed: tuple[int, ...] = ()
    engine: AutoEngine = "auto"
    driver: Annotated[str | None, choice(DRIVERS)] = None
    duration_s: float | None = None
    detect_every_s: float | None = None
    latency_s: float | None = None
    look_ahead_s: float | None = None

    @property
    def radios(self) -> tuple[str, ...]:
        """Radio channels with their changes."""
        return changed_radios(self.channel, self.loss, self.delay_s, self.pose_error)
