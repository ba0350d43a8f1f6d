"""The command line: one subcommand per verb. Heavy imports happen inside the verb that needs them."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg
from tyro.extras import SubcommandApp

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

app = SubcommandApp()


def run(args: list[str] | None = None) -> None:
    """Parse `args` (default: the process's) and run the verb."""
    app.cli(
        prog="dsrc",
        description="A CPU-first testbed for cooperative driving: simulate, sense, corrupt, detect, drive, review.",
        args=args,
        use_underscores=False,
    )


def _console() -> "Console":
    from rich.console import Console

    return Console(highlight=False)


def _say(text: str) -> None:
    """Write one line for people or scripts on standard output."""
    sys.stdout.write(f"{text}\n")


@contextmanager
def _progress() -> "Iterator[Progress]":
    """A progress display with elapsed and remaining time; plain and quiet when nobody watches."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    progress = Progress(*columns)
    progress.start()
    try:
        yield progress
    except BaseException:
        # What went wrong is not told below an empty bar.
        progress.live.transient = not any(task.completed for task in progress.tasks)
        progress.live.stop()
        raise
    progress.stop()


@app.command(name="scenarios")
def scenarios(
    action: Positional[Literal["list", "show", "import"]] = "list",
    file: Positional[str] = "",
    /,
    name: str = "",
    out: Path | None = None,
) -> None:
    """List the shipped scenarios, show one, or make one of a map of your own.

    A map is a SUMO network (.net.xml, .net.xml.gz), an OpenStreetMap extract (.osm, .osm.gz, .osm.bz2, .osm.pbf) or an
    OpenDRIVE file (.xodr). Its roads, and from OpenStreetMap its houses, trees, lamps, hedges, fences and walls, become
    a folder that `dsrc generate` takes.

    Args:
        action: what to do.
        file: for `show` a shipped scenario or the path of a scenario.toml, for `import` the map.
        name: of the scenario that is made, for `import`; default: from the file.
        out: the folder that is made, for `import`; default: one of that name here.
    """
    from sim.catalog.load import list_scenarios, load_scenario

    if action == "import":
        from sim.catalog.import_map import import_map
        from sim.errors import SettingsError

        if not file:
            raise SettingsError("scenarios import: file: expected a map, found nothing")
        folder = import_map(Path(file), name, out)
        _say(f"{folder}\ndsrc generate {folder} --out data")
        return
    if action == "show":
        import msgspec

        from sim.errors import SettingsError, did_you_mean

        if not file:
            raise SettingsError(
                f"scenarios show: file: expected a scenario, found nothing{did_you_mean('', list_scenarios())}"
            )
        from sensors.presets import scenario_lidars

        scenario = load_scenario(file)
        scenario_lidars(scenario)  # what is shown can be generated
        _say(msgspec.json.format(msgspec.json.encode(scenario).decode(), indent=2))
        return
    from dsrc.data.datasets.spec import list_datasets

    known = {name: load_scenario(name) for name in list_scenarios()}
    groups = {
        "Places": {name: one.description for name, one in known.items() if one.conflict is None},
        "Encounters": {name: one.description for name, one in known.items() if one.conflict is not None},
        "Datasets": list_datasets(),
    }
    for title, members in groups.items():
        _say(f"{title}:")
        for name, description in members.items():
            _say(f"  {name:30s} {description}")


@app.command(name="generate")
def generate(
    source: Positional[str],
    /,
    out: Path | None = None,
    frames: int | None = None,
    seed: int | None = None,
    interval: float | None = None,
    motion: Literal["middle", "start", "end", "raw"] | None = None,
    connected_vehicles: bool | None = None,
    visibility: bool | None = None,
    splits: tuple[str, ...] = (),
    workers: int | None = None,
    executor: str = "local",
    address: str = "",
    cards: bool = True,
    record: bool = False,
) -> None:
    """Simulate drives, scan them with every agent's LiDAR and write them as OPV2V trees.

    A scenario gives one drive, a TOML of splits a whole dataset. Killed and started again, it goes on where it stopped;
    the bytes are the same for any number of workers.

    Args:
        source: a shipped scenario, the path of a scenario.toml, a shipped dataset or a TOML of splits.
        out: the split folder, and the drive becomes OUT/SCENARIO_SEED; or the dataset, with OUT/SPLIT/DRIVE.
        frames: of one drive: synchronised frames to write; default: 100.
        seed: of one drive: of everything random; default: the scenario's own.
        interval: of one drive: seconds between written frames, a multiple of the LiDAR's 0.1 s, the default.
        motion: of one drive: the sensors' own motion is compensated to the middle (default), start or end of their
            sweeps, or not (raw).
        connected_vehicles: of one drive: list the other agents' bodies among an agent's vehicles (default); OPV2V
            leaves them out.
        visibility: of one drive: measure which share of every object each agent's rays reach (default), for a fifth of
            the time.
        splits: of a dataset: only these.
        workers: of a dataset: processes, or processors of Ray; default: one per core.
        executor: of a dataset: local, or ray for a cluster whose machines share OUT.
        address: of the Ray cluster; default: Ray on this machine.
        cards: of a dataset: write a data card beside each split.
        record: of a dataset: write only traffic logs and worlds, into the folder that its TOML calls `recorded`.
    """
    from dsrc.data.datasets.spec import find_split_file
    from sim.errors import SettingsError, complaint

    options = {"frames": frames, "seed": seed, "interval_s": interval, "motion": motion}
    options |= {"connected_vehicles": connected_vehicles, "visibility": visibility}
    single: dict[str, Any] = {name: value for name, value in options.items() if value is not None}
    if out is None and not record:
        raise SettingsError(complaint("generate", "out", "a folder", "nothing"))
    dataset = find_split_file(source)
    if dataset is not None:
        if single:
            hint = "; a dataset has it in its TOML"
            raise SettingsError(complaint("generate", next(iter(single)), "nothing", next(iter(single.values())), hint))
        _generate_dataset(dataset, out, splits, workers, executor, address, cards, record)
        return
    from dsrc.data.write import generate as make_drive
    from sim.catalog.load import load_scenario

    if out is None or splits or executor != "local" or address or record or workers is not None:
        raise SettingsError(complaint("generate", "source", "a TOML of splits for these options", source))
    spec = load_scenario(source)
    single["seed"] = spec.seed if seed is None else seed
    with _progress() as progress:
        task = progress.add_task(f"{spec.name} seed {single['seed']}", total=frames)
        drive = make_drive(
            spec, out, progress=lambda done, total: progress.update(task, completed=done, total=total), **single
        )
    _say(str(drive))


def _generate_dataset(
    source: Path,
    out: Path | None,
    splits: tuple[str, ...],
    workers: int | None,
    executor: str,
    address: str,
    cards: bool,
    record: bool,
) -> None:
    from dsrc.data.datasets.build import generate_dataset, record_dataset

    with _progress() as progress:
        task = progress.add_task(f"record {source}" if record else str(source), total=None)

        def tell(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        if record or out is None:
            folder = record_dataset(source, workers, tell)
        else:
            folder = generate_dataset(source, out, splits, workers, executor, address, cards, progress=tell)
    _say(str(folder))


@app.command(name="render")
def render(
    source: Positional[Path],
    /,
    out: Path,
    lidar: str | None = None,
    roadside_lidar: str | None = None,
    roadside: bool = True,
    vehicles: int | None = None,
    agents: tuple[int, ...] = (),
    mount: tuple[float, float, float, float] | None = None,
    frames: int | None = None,
) -> None:
    """Make drives anew from their traffic logs, for other sensors, agents or mountings, without SUMO.

    Args:
        source: a traffic log, a drive, or a folder of drives.
        out: where the drives go, under their names.
        lidar: preset of the vehicles' sensors.
        roadside_lidar: preset of the roadside units' sensors.
        roadside: whether the roadside units stand there.
        vehicles: how many vehicles carry a LiDAR.
        agents: ids of those that do, ego first.
        mount: x y z, m, in the body frame, and pitch, deg, of the vehicles' sensors.
        frames: the first so many.
    """
    from dsrc.data.datasets.render import Changes
    from dsrc.data.datasets.render import render as render_drives

    changes = Changes(lidar, roadside_lidar, roadside, vehicles, agents, mount, frames)
    with _progress() as progress:
        task = progress.add_task(str(source), total=None)
        made = render_drives(
            source, out, changes, progress=lambda done, total: progress.update(task, completed=done, total=total)
        )
    for drive in made:
        _say(str(drive))


@app.command(name="data")
def data(
    action: Positional[Literal["check", "card"]],
    folder: Positional[Path],
    /,
    out: Path | None = None,
    workers: int | None = None,
) -> None:
    """Check drives of any format that is read, or describe them.

    Args:
        action: check lists what is wrong, file by file; card writes counts, histograms and pictures.
        folder: a drive, or a folder of drives or splits.
        out: folder of the card; default: FOLDER.card.
        workers: processes; default: one per core.
    """
    if action == "card":
        from dsrc.data.datasets.card import write_card
        from dsrc.data.executors import open_executor

        with open_executor("local", workers) as pool:
            _say(str(write_card(folder, out, pool)))
        return
    from dsrc.data.datasets.check import check_dataset
    from sim.errors import DataError

    with _progress() as progress:
        task = progress.add_task(f"check {folder}", total=None)
        faults = check_dataset(folder, workers, lambda done, total: progress.update(task, completed=done, total=total))
    for fault in faults:
        _say(str(fault))
    if faults:
        raise DataError(f"{folder}: {len(faults)} thing{'s are' if len(faults) > 1 else ' is'} wrong")
    _say(f"{folder}: nothing is wrong")


@app.command(name="corrupt")
def corrupt(
    data: Positional[Path],
    /,
    kind: str,
    out: Path,
    severity: int = 3,
    family: Literal["physical", "paper"] = "physical",
    seed: int = 0,
    workers: int | None = None,
) -> None:
    """Write drives again as they are in fog, snow or rain, or with failing sensors.

    Killed and started again, it goes on where it stopped; the bytes are the same for any number of workers.

    Args:
        data: folder of drives, or one drive.
        kind: of the corruption, such as fog; a wrong one is answered with the right ones.
        out: folder of the corrupted drives, which keep their names.
        severity: 1 to 5; 3 is the paper's.
        family: physical models, or those of the published papers.
        seed: of the corruption; every drive draws its own weather and faults from it.
        workers: processes; default: one per core.
    """
    import os

    from dsrc.data.datasets.corrupt import corrupt_dataset

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with _progress() as progress:
        task = progress.add_task(f"{kind.replace('_', ' ')}, severity {severity}", total=None)
        corrupt_dataset(
            data,
            out,
            kind,
            severity,
            family,
            seed=seed,
            workers=cores if workers is None else workers,
            progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    _say(str(out))


@app.command(name="convert")
def convert(
    data: Positional[Path],
    /,
    to: Literal["opv2v", "dair", "kitti", "mcap"],
    out: Path,
    agent: str | None = None,
    view: Literal["camera", "around"] = "camera",
) -> None:
    """Write drives in another format; reads OPV2V, V2XSet, V2V4Real and DAIR-V2X-C trees as they come.

    Killed and started again, it goes on where it stopped; a folder that holds something else is refused.

    Args:
        data: folder of drives, or one drive; a split of a DAIR-V2X-C tree is TREE/val.
        to: the new format; mcap is for Foxglove and needs the package mcap.
        out: folder of the new tree.
        agent: whose eyes: ego, all (KITTI) or an agent's id; default: the ego. OPV2V and MCAP hold all agents.
        view: of KITTI's labels: those in a nominal camera's picture, or all around.
    """
    from dsrc.data.datasets.convert import convert as convert_drives

    with _progress() as progress:
        task = progress.add_task(f"convert to {to}", total=None)
        convert_drives(
            data,
            out,
            to,
            agent=agent,
            view=view,
            progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    _say(str(out))


@app.command(name="train")
def train(
    recipe: Positional[str],
    /,
    data: Path,
    out: Path,
    stage: Literal["all", "teacher", "student", "plain"] = "all",
    teacher: Path | None = None,
    validate: Path | None = None,
    seed: int = 0,
    epochs: int | None = None,
    method: str | None = None,
    init: Path | None = None,
    devices: int = 1,
    set: Annotated[tuple[str, ...], arg(metavar="FIELD=VALUE")] = (),
) -> None:
    """Train a detector; started again in the same folder it resumes.

    Args:
        recipe: debug, small, opv2v, dsrc-paper (as the text) or dsrc-code (as released).
        data: folder of drives to train on.
        out: run folder; one subfolder per stage.
        stage: all = teacher, then student; plain = the student without teacher and reconstruction.
        teacher: a trained teacher's detector.pt for `--stage student`; default: the one in OUT.
        validate: folder of drives for the validation AP; default: a part of DATA.
        seed: of weights, order and augmentation.
        epochs: instead of the recipe's.
        method: dsrc, or a rival in the same preset, such as v2x-vit; a wrong one is answered with the right ones.
        init: a detector.pt to start from: the weights whose name and shape agree are taken.
        devices: GPUs, or processes without one, that share each batch; torchrun brings its own number.
        set: change settings of the model, of the recipe or of a part of it: `--set sdd=false fusion=max
            epoch_frames=1000 augmentation.corruption=0.5`.
    """
    from dsrc.training.train import leads, train_stages

    detector = train_stages(
        recipe,
        data=data,
        out=out,
        stage=stage,
        teacher=teacher,
        validate=validate,
        seed=seed,
        epochs=epochs,
        overrides=set,
        method=method,
        init=init,
        devices=devices,
    )
    if leads():
        _say(str(detector))


@app.command(name="verify")
def verify(run: Positional[Path], /, data: Path | None = None, validate: Path | None = None) -> None:
    """Evaluate the detector of a training again and compare with what its run folder says; exit code 1 if they differ.

    Args:
        run: folder of a finished training, or of one with several stages.
        data: folder of the training drives, if they have moved.
        validate: folder of the validation drives, if they have moved.
    """
    from dsrc.training.verify import agree, runs_in
    from dsrc.training.verify import verify as verify_run

    whole = True
    with _progress() as progress:
        for folder in runs_in(run):
            task = progress.add_task(f"verify {folder}", total=None)

            def tell(done: int, total: int, task: Any = task) -> None:
                progress.update(task, completed=done, total=total)

            checks = verify_run(folder, data, validate, tell)
            whole &= agree(checks)
            _say("\n".join([str(folder), *(f"  {check}" for check in checks)]))
    if not whole:
        raise SystemExit(1)


@app.command(name="import-checkpoint")
def import_checkpoint(
    file: Positional[Path],
    /,
    out: Path,
    teacher: bool = False,
    range_m: tuple[float, float, float, float, float, float] = (-140.8, -40.0, -3.0, 140.8, 40.0, 1.0),
    cell: float = 0.4,
) -> None:
    """Make a detector of a state dict that DSRC's published code has written (net_epoch....pth).

    Args:
        file: of the base model, of a student or of a teacher; only tensors are read, no code is run.
        out: the detector file, in full precision.
        teacher: take the teacher's half of the file.
        range_m: x, y, z of the low and of the high corner of the range that it was trained for, m.
        cell: side of its pillars, m.
    """
    from dsrc.models.storage.checkpoint import save_detector
    from dsrc.models.storage.import_opencood import import_detector
    from dsrc.ops.grid import GridSpec
    from sim.errors import SettingsError

    try:
        grid = GridSpec(range_m=range_m, cell_m=cell)
    except ValueError as error:
        raise SettingsError(f"import-checkpoint: {error}") from None
    save_detector(out, import_detector(file, grid, teacher), {"imported from": file.name}, half=False)
    _say(str(out))


@app.command(name="export")
def export(
    detector: Positional[Path],
    /,
    out: Path,
    agents: int = 2,
) -> None:
    """Write a detector as an ONNX file; what goes in are the points of one sample, sorted into pillars.

    Args:
        detector: detector file.
        out: the ONNX file.
        agents: how many there are, the ego included, where the method does not take any number.
    """
    from dsrc.models.storage.checkpoint import load_detector
    from dsrc.models.storage.export import INPUTS, OUTPUTS, export_onnx

    taken = export_onnx(load_detector(detector), out, agents)
    _say("\n".join(f"{name}: {meaning}" for name, meaning in (INPUTS | OUTPUTS).items()))
    _say(f"agents: {taken}")
    _say(str(out))


@app.command(name="evaluate")
def evaluate(
    checkpoints: Positional[tuple[Path, ...]],
    /,
    data: Path,
    out: Path,
    corruptions: tuple[str, ...] = ("paper_six",),
    severity: int = 3,
    family: Literal["physical", "paper"] = "physical",
    seed: int = 0,
    limit: int | None = None,
    ego_alone: bool = True,
    channels: tuple[str, ...] = (),
    engine: Literal["fused", "bf16", "compiled", "plain"] = "fused",
) -> None:
    """Evaluate detectors on drives, clean and corrupted: table, CSV, JSON and plots.

    Args:
        checkpoints: detector files; `name=path` gives a row its name.
        data: folder of drives.
        out: folder for results.csv, results.json and the plots.
        corruptions: kinds, `paper_six` for those of the paper's table, `all` or `clean`.
        severity: 1 to 5; 3 is the paper's setting.
        family: physical models, or those of the published papers.
        seed: of the corruptions.
        limit: evaluate at most this many frames, evenly spread.
        ego_alone: also evaluate the first detector without collaborators.
        channels: radio channels: ideal, paper, its-g5-6, its-g5-27, c-v2x or trace:FILE; default: nothing is lost
            or late, and nothing counted.
        engine: how the networks run: fused layers, the same in half precision for CPUs with AMX, PyTorch's compiler, or
            layer by layer.
    """
    from dsrc.evaluation.run import evaluate_checkpoints

    with _progress() as progress:
        task = progress.add_task("evaluate", total=None)
        table = evaluate_checkpoints(
            checkpoints,
            data=data,
            out=out,
            corruptions=corruptions,
            severity=severity,
            seed=seed,
            limit=limit,
            ego_alone=ego_alone,
            family=family,
            channels=channels,
            engine=engine,
            progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    _console().print(table)
    _say(str(out))


@app.command(name="benchmark")
def benchmark(
    what: Positional[tuple[str, ...]],
    /,
    out: Path,
    data: tuple[str, ...] = (),
    corruptions: tuple[str, ...] | None = None,
    severities: tuple[int, ...] | None = None,
    family: Literal["physical", "paper"] | None = None,
    channels: tuple[str, ...] | None = None,
    agents: tuple[int, ...] | None = None,
    pose_error: tuple[float, ...] | None = None,
    delay_s: tuple[float, ...] | None = None,
    loss: tuple[float, ...] | None = None,
    limit: int | None = None,
    seed: int | None = None,
    docs: Path | None = None,
    partial: bool = False,
    workers: int = 1,
    device: Literal["cpu", "cuda"] = "cpu",
) -> None:
    """Compare methods as the paper's tables do: methods x corruptions x severities x datasets x channels.

    Killed and started again, it goes on where it stopped; a method that is added costs its own evaluations alone.

    Args:
        what: a TOML file that describes the benchmark, or detector files: `name=path` names a method, and a name with
            several files is one that was trained several times.
        out: folder for results, tables and plots, and for the cells that they are made of.
        data: folders of drives, each a dataset with tables of its own; `name=folder` names one.
        corruptions: kinds, `paper_six` for those of the paper's table (the default), `all` or `clean`.
        severities: 1 to 5; default: 3, the paper's.
        family: of the corruptions' settings: physical models (the default), or those of the published papers.
        channels: radio channels: ideal (the default), paper, its-g5-6, its-g5-27, c-v2x or trace:FILE.
        agents: numbers of agents to compare, for Figure 7, such as 1 2 3 4 5.
        pose_error: errors of the collaborators' poses to compare, m and degrees, such as 0.2 0.4.
        delay_s: delays to compare, s.
        loss: shares of lost packets to compare.
        limit: evaluate at most this many frames of a dataset, evenly spread.
        seed: of corruptions and channels.
        docs: put the tables into this Markdown document too, between its markers or at its end, and files beside it.
        partial: leave out detectors whose files are not there yet, and say which.
        workers: processes, of one thread each; the results are the same for any number.
        device: of the networks.
    """
    from dsrc.evaluation.config import available, plan_of
    from dsrc.evaluation.files import write_atomic
    from dsrc.evaluation.report.paper_tables import View, table_1
    from dsrc.evaluation.report.pictures import check_pictures, write_pictures
    from dsrc.evaluation.report.report import publish, write_report
    from dsrc.evaluation.runner import run_plan

    flags = {"corruptions": corruptions, "severities": severities, "family": family, "channels": channels}
    sweeps = {"agents": agents, "pose_error": pose_error, "delay_s": delay_s, "loss": loss}
    plan = plan_of(what, data, {**flags, "limit": limit, "seed": seed}, sweeps)
    plan, absent = available(plan) if partial else (plan, [])
    check_pictures(plan)
    with _progress() as progress:
        task = progress.add_task(f"benchmark {plan.name}", total=None)
        outcome = run_plan(
            plan, out, workers, device, lambda done, total: progress.update(task, completed=done, total=total)
        )
    blocks = [*write_report(outcome, out), *write_pictures(outcome, out)]
    write_atomic(out / "tables.md", "\n".join(block.markdown(Path()) for block in blocks))
    for dataset in plan.datasets:
        sheet = table_1(View.of(outcome, dataset.name))
        console = _console()
        console.print(sheet.terminal(len(sheet.columns) - 2, console.width))  # bytes and times are in the files
    for block in blocks:
        if not block.picture and "left out: " in block.text:
            _say(block.text.strip())
    if absent:
        _say(f"Left out, for they are not there: {', '.join(absent)}.")
    if docs is not None:
        publish(blocks, out, docs, plan.name)
        _say(str(docs))
    _say(str(out / "tables.md"))


@app.command(name="view")
def view(
    data: Positional[Path],
    /,
    checkpoint: Path | None = None,
    corruption: str = "clean",
    severity: int = 3,
    family: Literal["physical", "paper"] = "physical",
    port: int | None = None,
    export: Path | None = None,
    picture: Path | None = None,
    limit: int = 40,
) -> None:
    """Review drives in the browser, or write one self-contained page.

    Args:
        data: folder of drives, or one drive.
        checkpoint: a detector whose detections are drawn and matched.
        corruption: the corruption to begin with.
        severity: 1 to 5.
        family: physical models, or those of the published papers.
        port: of the page on 127.0.0.1; default: a free one.
        export: write this HTML page and leave.
        picture: with `--export`, write a PNG of the page too; needs Chromium.
        limit: frames in an exported page.
    """
    if picture is not None and export is None:
        from sim.errors import SettingsError

        raise SettingsError("view: picture: expected together with --export, found without")
    if export is not None:
        from dsrc.review.page.export import export_html

        page = export_html(
            data,
            export,
            checkpoint=checkpoint,
            corruption=corruption,
            severity=severity,
            frames=limit,
            family=family,
        )
        _say(str(page))
        if picture is not None:
            from dsrc.review.page.screenshot import screenshot

            _say(str(screenshot(page, picture)))
        return
    from dsrc.review.page.app import serve

    serve(data, checkpoint, port=port, corruption=corruption, severity=severity, announce=_say, family=family)


@app.command(name="drive")
def drive(
    scenario: Positional[str],
    /,
    perception: Literal["truth", "ego", "dsrc"] = "truth",
    checkpoint: Path | None = None,
    corruption: str = "clean",
    severity: int = 3,
    family: Literal["physical", "paper"] = "physical",
    seeds: tuple[int, ...] = (0,),
    duration: float = 20.0,
    channel: str = "ideal",
    out: Path | None = None,
) -> None:
    """Drive closed-loop episodes: the ego brakes for what its perception shows it, nothing else.

    Args:
        scenario: a shipped scenario or the path of a scenario.toml.
        perception: truth, the ego's detector alone, or with collaborators.
        checkpoint: a detector; default: the shipped one.
        corruption: of every agent's sweeps.
        severity: 1 to 5.
        family: physical models, or those of the published papers.
        seeds: one episode each.
        duration: of an episode, s.
        channel: radio channel: ideal, paper, its-g5-6, its-g5-27, c-v2x or trace:FILE.
        out: write the rows to this CSV file.
    """
    from dsrc.closed_loop.episodes import drive_episodes

    with _progress() as progress:
        task = progress.add_task(f"drive {perception}", total=None)
        table = drive_episodes(
            scenario,
            perception=perception,
            checkpoint=checkpoint,
            corruption=corruption,
            severity=severity,
            family=family,
            seeds=seeds,
            duration_s=duration,
            channel=channel,
            out=out,
            progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    _console().print(table)


@app.command(name="demo")
def demo(out: Path = Path("demo"), quick: bool = False) -> None:
    """Walk the whole testbed on a real junction: generate, evaluate, look, drive. About two minutes on 2 cores.

    Args:
        out: folder for everything that the demo makes; an interrupted demo goes on there.
        quick: a few frames only, to see that everything works.
    """
    from dsrc.cli.demo import run_demo

    run_demo(out, quick=quick)
