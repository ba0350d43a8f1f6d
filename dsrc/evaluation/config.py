"""Settings of a benchmark, a TOML: methods x datasets x corruptions x severities x channels, and parameter sweeps.

    name = "small"
    corruption = ["paper_six"]
    family = ["physical", "paper"]    # tables of each; default: physical
    severity = [3]
    fault = ["fog:3 on helpers + loss:0.3"]   # a line of the tables each; default: none
    channel = ["ideal"]
    frames = 300                      # of each dataset, evenly spread; default: all

    [[methods]]
    name = "DSRC"
    detectors = ["runs/dsrc_0/student/detector.pt", "runs/dsrc_1/student/detector.pt"]   # one per training

    [[methods]]
    name = "DSRC that sends a tenth"
    detectors = ["runs/dsrc_0/student/detector.pt", "runs/dsrc_1/student/detector.pt"]
    use = {share = 0.1}
    start = "own, maximum"            # what its training began with, for Table 1

    [[datasets]]
    name = "dsrc-sim"
    drives = ["data/dsrc-sim/test"]

    [[differences]]                   # with intervals, by frame and by drive
    method = "DSRC that sends a tenth"
    baseline = "DSRC"

    [[notes]]                         # marks the lines of methods in all tables
    methods = ["DSRC that sends a tenth"]
    text = "Never trained to send less."

    [sweeps]                          # clean frames, one quantity at a time, an ideal channel otherwise
    agents = [1, 2, 3, 4, 5]
    pose_error = [0.1, 0.2, 0.4, 0.8]
    delay_s = [0.1, 0.2, 0.4]
    loss = [0.1, 0.3, 0.5]

Paths are relative to the file, or else to the current folder.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_type_hints

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from dsrc.detectors.levelled import check_height
from dsrc.detectors.texts import NO_COMMAND, is_there, kind_of, named, split_name
from dsrc.faults.condition import faults_of, frame_condition, settled
from dsrc.messages.defences import Defence, parse_defence
from dsrc.models.settings import ModelSettings
from dsrc.options.detection import BenchmarkOptions, Comparison
from dsrc.options.fields import RENAMED
from dsrc.options.told import DEFENCES, MESSAGES, SINGLE_DEFENCES
from sensors.corruptions import Condition, conditions_of
from sim.errors import SettingsError, complaint, did_you_mean, option
from sim.radio import IDEAL, ChannelSpec, Radio, get_channel
from sim.settings import convert, read_toml

_Texts = Annotated[tuple[str, ...], Meta(min_length=1)]
IN_USE = (
    *("drop_lone_points", "align_poses", "share", "bits", "score_threshold", "nms_iou", "max_extent_m"),
    *("comm_range_m", "team_by", "judged_by"),
)
"""Model settings that a trained detector can be used with at any value."""

_Amounts = tuple[Annotated[float, Meta(ge=0.0, le=1e6)], ...]


class MethodSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Method of a benchmark, a line of its tables.

    Attributes:
        name: in tables.
        detectors: detectors, one for each training of the method; see `dsrc.detectors.open`.
        use: changed model settings, of `IN_USE`, `height`, see `dsrc.detectors.levelled`, `messages` of agents that
            detect alone, and their ego's `defence`, see `dsrc.evaluation.listener`: the same detectors that send less,
            or that correct poses, are another method. With `judged_by = "opencood"` the `ap_opencood` of a
            method is OpenCOOD's number, see `dsrc.data.sample.JudgedBy`.
        start: weights that its trainings began with, for a column of Table 1; "" for unknown.
        agents: most agents that take part, the ego included; None for the detectors' own number.
    """

    name: str
    detectors: _Texts
    use: dict[str, bool | int | float | str] = {}
    start: str = ""
    agents: Annotated[int, Meta(ge=1)] | None = None


class DatasetSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Dataset of a benchmark: drives evaluated together.

    Attributes:
        name: in tables.
        drives: folders of drives.
    """

    name: str
    drives: _Texts


class DifferenceSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pair of methods whose difference gets intervals.

    Attributes:
        method: whose gain is measured.
        baseline: compared with.
    """

    method: str
    baseline: str


class Footnote(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Footnote of the tables.

    Attributes:
        methods: methods whose lines get its mark.
        text: below each table with one of them.
    """

    methods: _Texts
    text: Annotated[str, Meta(min_length=1)]


class ParameterSweeps(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameter sweeps, one quantity at a time, in clean frames with an ideal channel.

    Attributes:
        methods: swept methods; empty: all.
        agents: numbers of agents, the ego included.
        pose_error: standard deviations of the collaborators' positions, m, and headings, degrees, drawn in every frame.
        delay_s: delays of messages, s.
        loss: packet loss rates.
    """

    methods: tuple[str, ...] = ()
    agents: tuple[Annotated[int, Meta(ge=1)], ...] = ()
    pose_error: _Amounts = ()
    delay_s: _Amounts = ()
    loss: tuple[Annotated[float, Meta(ge=0.0, le=1.0)], ...] = ()


class Benchmark(Comparison, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of a benchmark: what `Comparison` has, and methods on datasets.

    Attributes:
        methods: lines of the tables, in their order.
        datasets: each with tables of its own.
        name: of the benchmark.
        differences: pairs of methods to compare.
        notes: footnotes, marked in their order.
        sweeps: parameter sweeps.
        pictures: settings of `studies/dsrc_paper`, which reads them; nothing here does.
    """

    methods: Annotated[tuple[MethodSpec, ...], Meta(min_length=1)]
    datasets: Annotated[tuple[DatasetSpec, ...], Meta(min_length=1)]
    name: str = "benchmark"
    differences: tuple[DifferenceSpec, ...] = ()
    notes: tuple[Footnote, ...] = ()
    sweeps: ParameterSweeps = ParameterSweeps()
    pictures: dict[str, object] = msgspec.field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Case:
    """Case of a benchmark: a method under one condition of one dataset, a row of the result.

    Attributes:
        method: name of the method.
        training: number of the method's detector, from 0.
        dataset: name of the dataset.
        condition: condition of the sweeps.
        channel: name of the channel.
        agents: most agents that take part; None for all.
        pose_error: as in `ParameterSweeps`; 0 for the channel's.
        delay_s: likewise.
        loss: likewise.
    """

    method: str
    training: int
    dataset: str
    condition: Condition
    channel: str = IDEAL
    agents: int | None = None
    pose_error: float = 0.0
    delay_s: float = 0.0
    loss: float = 0.0

    @property
    def swept(self) -> bool:
        """Whether the case belongs to a sweep."""
        return self.agents is not None or bool(self.pose_error or self.delay_s or self.loss)

    def spec(self) -> ChannelSpec:
        """Settings of the channel, those of the sweep and of faults that act on all messages included."""
        swept = self.loss or None, self.delay_s or None, self.pose_error or None
        channel = settled(faults_of(self.condition), self.channel).channel
        return Radio.parse(channel).changed(*swept).spec()


def read_benchmark(path: Path) -> Benchmark:
    """Read and check the TOML of a benchmark; its paths are resolved.

    Raises:
        SettingsError: the file is invalid; one line names the field.
    """
    plan: Benchmark = read_toml(path, Benchmark, SettingsError, RENAMED)

    def found(name: str) -> str:
        beside = path.parent / name
        return str(beside if beside.exists() else name)

    for method in plan.methods:
        if any(kind_of(text) == "pipe" for text in method.detectors):
            raise SettingsError(complaint(path, f"methods.{method.name}.detectors", NO_COMMAND, method.detectors[0]))
    methods = tuple(replace(m, detectors=tuple(map(found, m.detectors))) for m in plan.methods)
    datasets = tuple(replace(d, drives=tuple(map(found, d.drives))) for d in plan.datasets)
    plan = replace(plan, methods=methods, datasets=datasets)
    check(plan, str(path))
    return plan


def plan_of(options: BenchmarkOptions) -> Benchmark:
    """Benchmark of a TOML, or of the options that describe one.

    Detector files that are given one name are the trainings of one method; each folder of drives is a dataset.

    Raises:
        SettingsError: invalid settings, or a file together with other options.
    """
    fields = msgspec.structs.fields(BenchmarkOptions)
    given = {one.name: value for one in fields if (value := getattr(options, one.name)) != one.default}
    path = given.pop("plan", None)
    if path is not None:
        if path.suffix != ".toml":
            hint = "; detector files go after --checkpoint"
            raise SettingsError(complaint("benchmark", "plan", "a .toml", str(path), hint))
        for one in fields:
            if one.name in given:
                raise SettingsError(f"benchmark: {path} describes the benchmark; leave out {option(one.name)}")
        return read_benchmark(path)
    methods = _grouped("checkpoint", given.pop("checkpoint", ()))
    datasets = _grouped("data", given.pop("data", ()))
    for field, found in (("checkpoint", methods), ("data", datasets)):
        if not found:
            raise SettingsError(f"benchmark: nothing to compare; add --{field}, or the TOML of a benchmark")
    listed = {
        "methods": [{"name": name, "detectors": files} for name, files in methods.items()],
        "datasets": [{"name": name, "drives": folders} for name, folders in datasets.items()],
        "sweeps": {name: given.pop(name) for name in ParameterSweeps.__struct_fields__ if name in given},
        **given,
    }
    plan = convert(listed, Benchmark, "benchmark", SettingsError)
    check(plan, "benchmark")
    return plan


def _grouped(field: str, texts: Sequence[str]) -> dict[str, list[str]]:
    """Paths by name; only paths with a given name can share one."""
    groups: dict[str, list[str]] = {}
    for (name, path), text in zip(named(texts), texts, strict=True):
        if name in groups and split_name(text)[0] != name:
            hint = "; give names: name=path"
            raise SettingsError(complaint("benchmark", field, "names that differ", f"{name} for {path} too", hint))
        groups.setdefault(name, []).append(path)
    return groups


def check(plan: Benchmark, where: str) -> None:
    """Raise SettingsError for repeated or unknown names and numbers out of range; `where` begins the message."""
    names = [method.name for method in plan.methods]
    for field, given in (
        ("methods", names),
        ("datasets", [dataset.name for dataset in plan.datasets]),
        ("channel", list(plan.channel)),
        ("severity", list(map(str, plan.severity))),
        ("family", list(map(str, plan.family))),
    ):
        repeated = sorted({name for name in given if given.count(name) > 1})
        if repeated:
            raise SettingsError(complaint(where, field, "names that differ", repeated[0]))
        if not all(given):
            raise SettingsError(complaint(where, field, "names that are not empty", "''"))
    for field, wanted in (
        ("sweeps.methods", plan.sweeps.methods),
        ("differences.method", tuple(pair.method for pair in plan.differences)),
        ("differences.baseline", tuple(pair.baseline for pair in plan.differences)),
        ("notes.methods", tuple(name for note in plan.notes for name in note.methods)),
    ):
        for name in wanted:
            if name not in names:
                raise SettingsError(complaint(where, field, "one of the methods", name, did_you_mean(name, names)))
    for i, pair in enumerate(plan.differences):
        if pair.method == pair.baseline:
            raise SettingsError(complaint(where, f"differences[{i}].baseline", "another method", pair.baseline))
        if pair in plan.differences[:i]:
            found = f"{pair.method} and {pair.baseline} again"
            raise SettingsError(complaint(where, f"differences[{i}]", "a pair that is not there yet", found))
    for method in plan.methods:
        for field, value in method.use.items():
            place = f"methods.{method.name}.use"
            if field == "height":
                check_height(f"{where}: {place}", value)
                continue
            if field == "messages":
                check_messages(str(value), f"{where}: {place}")
                continue
            if field == "defence":
                single_defence(str(value), f"{where}: {place}")
                continue
            if field not in IN_USE:
                expected = "a setting that needs no training"
                known = (*IN_USE, "height", "messages", "defence")
                raise SettingsError(complaint(where, place, expected, field, did_you_mean(field, known)))
            hint = get_type_hints(ModelSettings, include_extras=True)[field]
            convert(value, hint, where, SettingsError, field=f"{place}.{field}")
    check_numbers(where, plan.seed, plan.frames)
    if not plan.severity:
        raise SettingsError(complaint(where, "severity", "at least one", "none"))
    plan_conditions(plan, where)
    try:
        for channel in plan.channel:
            get_channel(channel)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from None


def check_messages(text: str, where: str) -> None:
    """Raise SettingsError for what is none of `dsrc.options.told.MESSAGES`."""
    if text not in MESSAGES:
        raise SettingsError(complaint(where, "messages", "what helpers can tell", text, did_you_mean(text, MESSAGES)))


def single_defence(text: str, where: str) -> Defence:
    """Return the defences of a text that need no message but those of one instant, see `parse_defence`.

    Raises:
        SettingsError: as `parse_defence`, or another one.
    """
    for name in map(str.strip, text.split(",")):
        if name in DEFENCES and name not in SINGLE_DEFENCES:
            expected = f"{' or '.join(SINGLE_DEFENCES)}: frames are judged one by one"
            raise SettingsError(complaint(where, "defence", expected, f"{name}; it has a meaning in dsrc drive"))
    return parse_defence(text, where)


def check_numbers(where: str, seed: int, frames: int | None) -> None:
    """Raise SettingsError for a number out of its range; `where` begins the message."""
    if seed < 0:
        raise SettingsError(complaint(where, "seed", "at least 0", seed))
    if frames is not None and frames < 1:
        raise SettingsError(complaint(where, "frames", "at least 1", frames))


def available(plan: Benchmark) -> tuple[Benchmark, list[str]]:
    """Benchmark of the detectors whose files exist, and the missing paths.

    Raises:
        SettingsError: all files are missing.
    """
    absent = [path for method in plan.methods for path in method.detectors if not is_there(path)]
    kept = [(method, tuple(path for path in method.detectors if path not in absent)) for method in plan.methods]
    methods = tuple(replace(method, detectors=paths) for method, paths in kept if paths)
    if not methods:
        raise SettingsError(complaint("benchmark", "methods", "at least one detector that is there", f"no {absent[0]}"))
    names = [method.name for method in methods]
    sweeps = replace(plan.sweeps, methods=tuple(name for name in plan.sweeps.methods if name in names))
    if plan.sweeps.methods and not sweeps.methods:
        sweeps = ParameterSweeps()
    differences = tuple(pair for pair in plan.differences if pair.method in names and pair.baseline in names)
    shown = ((note, tuple(name for name in note.methods if name in names)) for note in plan.notes)
    notes = tuple(replace(note, methods=kept) for note, kept in shown if kept)
    plan = replace(plan, methods=methods, differences=differences, notes=notes, sweeps=sweeps)
    return plan, absent


def plan_conditions(plan: Comparison, where: str = "benchmark") -> list[Condition]:
    """Return the conditions of a plan: clean, corruptions, then faults.

    Args:
        where: begins the messages of errors.

    Raises:
        SettingsError: as `conditions_of` and `frame_condition`.
    """
    corrupted = conditions_of(plan.corruption, plan.severity, plan.family, plan.corrupted_agents, where)
    return [*corrupted, *dict.fromkeys(frame_condition(text, where) for text in plan.fault)]


def cases_of(plan: Benchmark) -> list[Case]:
    """Cases of a benchmark, each once."""
    return list(dict.fromkeys(_cases(plan)))


def _cases(plan: Benchmark) -> Iterator[Case]:
    trained = [(method.name, row) for method in plan.methods for row in range(len(method.detectors))]
    for dataset in plan.datasets:
        for channel in plan.channel:
            for condition in plan_conditions(plan):
                for name, row in trained:
                    yield Case(name, row, dataset.name, condition, channel)
    sweeps = plan.sweeps
    clean = Condition()
    for dataset in plan.datasets:
        for name, row in trained:
            if sweeps.methods and name not in sweeps.methods:
                continue
            for agents in sweeps.agents:
                yield Case(name, row, dataset.name, clean, agents=agents)
            for error in sweeps.pose_error:
                yield Case(name, row, dataset.name, clean, pose_error=error)
            for delay in sweeps.delay_s:
                yield Case(name, row, dataset.name, clean, delay_s=delay)
            for loss in sweeps.loss:
                yield Case(name, row, dataset.name, clean, loss=loss)
