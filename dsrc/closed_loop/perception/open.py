"""Perceptions by name: truth, detectors by checkpoint, and classes of one's own."""

import os
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

from dsrc.closed_loop.perception.truth import SightPerception, TruthPerception
from dsrc.closed_loop.types import Perception
from dsrc.data.sample import SampleDetector
from dsrc.detectors.classes import OwnDetector, load_own
from dsrc.detectors.texts import SHIPPED_DETECTOR, kind_of, split_name
from dsrc.faults.fault import Fault, Faults, parse_faults, require_apart
from dsrc.faults.kinds import REPLAY
from dsrc.messages.cpm import RULES
from dsrc.messages.defences import Defence, parse_defence
from sensors.corruptions import CLEAN, DEFAULT_SEVERITY, EVERYONE, Condition, CorruptedAgents, Family
from sim.errors import SettingsError, complaint, did_you_mean, warn_deprecated
from sim.radio import IDEAL, PRESETS, ChannelSpec, get_channel

TEAM_SIGHT = "team-sight"
WITHOUT_SENSOR = ("truth", "sight", TEAM_SIGHT)
"""Ground truth: no corruption, channel or checkpoint applies."""
ALONE = "ego"
"""A detector on the ego's sweeps alone."""
TOGETHER = "team"
"""A detector with helpers."""
LATE = "late"
"""A detector of each agent alone, and their boxes joined."""
CPM = "cpm"
"""As `LATE`, by ETSI's Collective Perception Messages; `cpm-RULE` with a rule of redundancy mitigation."""
CPMS = (CPM, *(f"{CPM}-{rule}" for rule in RULES))
TELLING = (TEAM_SIGHT, LATE)
"""Helpers tell boxes, which the ego can refuse."""
WHO_TELLS = f"a perception whose helpers tell boxes, {' or '.join(TELLING)} (not ETSI's in episodes)"
MODELLED = "model"
"""Errors of a detector, drawn from a model of them; no sweep is cast."""
WHO_IS_LIED_TO = "a perception with helpers, such as team, late or team-sight (not ETSI's in episodes)"

_NAMES = (*WITHOUT_SENSOR, ALONE, TOGETHER, LATE, *CPMS)
_FORMER = {"dsrc": TOGETHER}
"""Names of earlier versions, which logs and plans still have."""
_IDEAL = PRESETS[IDEAL]


def open_perception(
    text: str,
    *,
    checkpoint: Path | None = None,
    corruption: str | Condition = CLEAN,
    severity: int = DEFAULT_SEVERITY,
    family: Family = "physical",
    corrupted_agents: CorruptedAgents | str = EVERYONE,
    channel: str | ChannelSpec = IDEAL,
    interval_s: float = 0.1,
    look_ahead_s: float = 0.0,
    engine: str = "auto",
    device: Literal["cpu", "cuda"] = "cpu",
    fault: str | Faults = (),
    defence: str | Defence = (),
    who: CorruptedAgents | str | None = None,
) -> Perception:
    """Return a perception by name.

    Args:
        text: one of

            * `truth`: all road users near the ego; `sight`: those that its LiDAR can see; `team-sight`: those that it
              or a helper's can;
            * `ego`: a detector on the ego's sweeps alone; `team`: one with helpers; `late`: each agent's detections,
              joined, by a detector whose fusion has no weights, such as the shipped ones; `cpm`: likewise, with the
              objects, resolution and sizes of ETSI's Collective Perception Messages;
              `cpm-dynamics`, `cpm-distance`: senders leave out what others tell, see `dsrc.messages.cpm`;
            * FILE or NAME=FILE: the detector of a file, with helpers; `ego=FILE`, `late=FILE`, `cpm=FILE`: as these;
            * FILE.json or NAME=FILE.json: an error model, see `dsrc model fit`; `model`: that of `checkpoint`;
            * `module:Class` of one's own, made without arguments: a perception (`reset`, `perceive`), or a detector
              (`detect(sample) -> Detections`, and `settings`, a `SampleRequest`, unless the shipped detector's serves).
              `classes` names what it detects: by default a detector vehicles, a perception everything. Modules of the
              current folder are found;
            * FILE.onnx, `pipe:COMMAND ...` or `tcp://localhost:PORT`: see `dsrc.detectors.open`.
        checkpoint: detector file of `ego`, `team` and `late`; None for the shipped one.
        corruption: condition of the sweeps, or the kind of it, or `clean`.
        severity: 1 to 5 of a kind; any for `clean`.
        family: of a kind.
        corrupted_agents: agents whose sweeps a kind corrupts: `all`, `ego`, `helpers`, or ids.
        channel: name or settings of the radio channel; it does not matter without helpers.
        interval_s: time between percepts, s.
        look_ahead_s: shift of a detector's range, see `LoopSettings`.
        engine: execution of the network, `auto` or a key of `dsrc.models.storage.deploy.ENGINES`; the perception's
            `engine` is what runs.
        device: of the network.
        fault: faults of the episode, see `dsrc.faults.fault`.
        defence: against helpers that lie, see `dsrc.messages.defences`: names between commas.
        who: former name of `corrupted_agents`.

    Raises:
        SettingsError: an unknown name, corruption or channel, a setting of something that the perception has not, or a
            class that does not load.
        CheckpointError: the detector file is missing or wrong, or its fusion has weights that `late` cannot have.
    """
    if who is not None:
        warn_deprecated("who", "corrupted_agents")
    _, name, file = parse_perception(text)
    radio = get_channel(channel) if isinstance(channel, str) else channel
    condition = corruption
    if isinstance(condition, str):
        condition = Condition.of(condition, severity, family, who if who is not None else corrupted_agents)
    corrupted = condition.checked().kind != CLEAN
    faults = parse_faults(fault, "perception") if isinstance(fault, str) else fault
    require_apart([*([Fault.of(condition)] if corrupted else []), *faults], "perception")
    defences = parse_defence(defence, "perception") if isinstance(defence, str) else defence
    if unheard := next((one for one in faults if one.attack and not hears(name, one)), None):
        expected = WHO_TELLS if unheard.kind == REPLAY else WHO_IS_LIED_TO
        raise SettingsError(complaint("perception", f"fault '{unheard.text}'", expected, text))
    if defences and name not in TELLING:
        raise SettingsError(complaint("perception", "defence", WHO_TELLS, text))
    sensed = any(one.needs for one in faults)
    if name in WITHOUT_SENSOR:
        given = {"corruption": corrupted, "channel": radio != _IDEAL, "checkpoint": checkpoint is not None}
        given["fault"] = any(one.needs and not one.attack for one in faults)
        _refuse(text, "a sensor", given)
        if name == "truth":
            return _with(TruthPerception(), faults)
        return SightPerception(cooperative=name == TEAM_SIGHT, faults=faults, defence=defences)
    if name == MODELLED:
        _refuse(text, "a sensor", {"fault": sensed})
        return _with(_modelled(text, Path(file) if file else checkpoint, condition, channel), faults)
    detector: Any
    if ":" in name:
        _refuse(text, "a checkpoint", {"checkpoint": checkpoint is not None})
        detector, engine = _own(name), "fused"
        if hasattr(detector, "perceive"):
            _refuse(text, "a detector", {"corruption": corrupted, "channel": radio != _IDEAL, "fault": sensed})
            return _with(cast(Perception, detector), faults)
    else:
        if file and checkpoint is not None:
            raise SettingsError(f"perception: '{text}' names a detector file already; leave out --checkpoint")
        path = Path(file) if file else checkpoint or SHIPPED_DETECTOR
        if not file and name not in _NAMES:
            hint = did_you_mean(name, _NAMES)
            raise SettingsError(complaint("perception", "name", "a name, FILE, NAME=FILE or module:Class", name, hint))
        detector, engine = _loaded(path, device, engine, late=name in (LATE, *CPMS))
    from dsrc.closed_loop.perception.cpm import CpmPerception
    from dsrc.closed_loop.perception.detector import DetectorPerception

    cooperative = name != ALONE
    spec = radio if cooperative else _IDEAL
    made: Any = partial(CpmPerception, rule=name[len(CPM) + 1 :]) if name in CPMS else DetectorPerception
    opened: Perception = made(
        cast(SampleDetector, detector),
        cooperative=cooperative,
        condition=condition,
        channel=spec,
        interval_s=interval_s,
        look_ahead_s=look_ahead_s,
        engine=engine,
        faults=faults,
        defence=defences,
    )
    return opened


class Words(NamedTuple):
    """Words of a command line that name a perception.

    Attributes:
        name: in tables: NAME of NAME=FILE, the stem of FILE, else what was given.
        kind: `truth`, `sight`, `team-sight`, `ego`, `team`, `late`, `model` or `module:Class`.
        file: detector or error model, "" without one.
    """

    name: str
    kind: str
    file: str


def parse_perception(text: str) -> Words:
    """Return the words of `truth`, FILE, NAME=FILE, NAME=ego.

    A bare FILE ends with .pt, .onnx or .json, or has a folder.
    """
    name, what = split_name(text)
    is_path = what.endswith((".pt", ".onnx", ".json")) or "/" in what or os.sep in what
    is_path = is_path and kind_of(what) not in ("pipe", "tcp")
    if not is_path and (not name or ":" in what or what in (*_NAMES, *_FORMER)):
        return Words(name or what, _FORMER.get(what, what), "")
    kind = MODELLED if what.endswith(".json") else name if name in (ALONE, LATE, *CPMS) else TOGETHER
    return Words(name or Path(what).stem, kind, what)


def uses_helpers(kind: str) -> bool:
    """Whether a perception of a kind of `Words` uses helpers."""
    return kind == TEAM_SIGHT or kind not in (*WITHOUT_SENSOR, ALONE)


def hears(kind: str, attack: Fault) -> bool:
    """Whether a perception of a kind of `Words` has helpers that an attack acts on."""
    shares = kind not in (*WITHOUT_SENSOR, ALONE, MODELLED, *CPMS)
    return kind in TELLING or (shares and attack.kind != REPLAY)


def _refuse(text: str, what: str, given: dict[str, bool]) -> None:
    """Raise SettingsError for a setting of something that a perception has not."""
    for field, is_given in given.items():
        if is_given:
            raise SettingsError(f"perception: '{text}' is without {what}; leave out --{field}")


def _with(perception: Perception, faults: Faults) -> Perception:
    """Return a perception that knows the faults of the episode, for the loop."""
    made: Any = perception
    if faults:
        made.faults = faults
    return perception


def _modelled(text: str, file: Path | None, condition: Condition, channel: str | ChannelSpec) -> Perception:
    from dsrc.closed_loop.perception.error_model.model import read_model
    from dsrc.closed_loop.perception.error_model.perception import ModelPerception

    if file is None:
        raise SettingsError(complaint("perception", "checkpoint", f"the JSON of an error model with '{text}'", "none"))
    if not isinstance(channel, str):
        raise SettingsError(complaint("perception", "channel", f"a name with '{text}'", "settings"))
    model = read_model(file)
    return ModelPerception(model, model.errors(file, condition, channel))


def _loaded(path: Path, device: Literal["cpu", "cuda"], engine: str, late: bool) -> tuple[SampleDetector, str]:
    """Return the detector of a file and the engine that runs it."""
    from dsrc.detectors.open import open_detector
    from dsrc.models.storage.checkpoint import load_joined
    from dsrc.models.storage.deploy import engine_for

    if kind_of(str(path)) == "onnx":
        if late:
            raise SettingsError(complaint("perception", "late", "a detector file", path))
        return open_detector(path), "fused"
    chosen = engine_for(path, engine, device)
    return load_joined(path, device, chosen, LATE if late else ""), chosen


def _own(text: str) -> Any:
    """Return a perception or a detector of one's own: of a class or a process.

    Raises:
        SettingsError: the module or the class does not load, or has neither `perceive` nor `detect`.
        DataError: the process does not answer.
    """
    from dsrc.detectors.open import open_detector

    if kind_of(text) in ("pipe", "tcp"):
        return open_detector(text)
    made = load_own(text, "perception", "reset and perceive, or with detect", "perceive+reset", "detect")
    return made if hasattr(made, "perceive") and hasattr(made, "reset") else OwnDetector(made, text)
