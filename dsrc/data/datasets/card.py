"""Data card of a split: its content in Markdown, JSON and pictures, in a folder beside the split.

Counts are of all drives; points, boxes and visible fractions of frames evenly spread over each drive, at most `SAMPLES`
of each.
"""

import hashlib
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.drives import list_drives, open_drive, path_below
from dsrc.data.formats.opv2v.reader import own_settings
from dsrc.data.jsonio import encode_json, read_json
from dsrc.runs.executors import SERIAL, Executor, Pool, Progress
from dsrc.tables.table import Column, Table, TableRow
from sensors.frame import BY_EGO, BY_HELPER, BY_NOBODY, Frame
from sim.boxes import CLASSES
from sim.catalog.attribution import attributions
from sim.errors import DataError
from sim.files import check_apart, check_folder, write_file
from sim.machine import installed_versions
from sim.scenario import Scenario

VERSION = 2
SAMPLES = 20
"""Frames of a drive that are sampled."""

RANGE_M = np.arange(0.0, 205.0, 5.0)
DISTANCE_M = np.array([0.0, 20.0, 40.0, 60.0, 80.0, 100.0, 150.0])
SHARE = np.linspace(0.0, 1.0, 11)
SEEN_BY = {"ego": BY_EGO, "helper only": BY_HELPER, "nobody": BY_NOBODY}

_PICTURES = 4
_VIEW_M = 100.0
_SEEN, _UNSEEN = "black", "#c00000"
_PACKAGES = ("dsrc-testbed", "numpy", "embreex", "libsumo", "eclipse-sumo")


class DriveCard(msgspec.Struct, kw_only=True):
    """Drive of a data card; histograms count over the sampled frames.

    Attributes:
        drive: its path below the split.
        sha256: digest of the drive, see `dsrc.data.drives.Drive.digest`.
        format: of its files.
        frames: number of frames.
        sampled: numbers of the sampled frames.
        seconds: from the first frame to the last.
        agents: id -> kind and LiDAR.
        settings: scenario, seed and options, as far as its protocol has them.
        points: per sampled frame and agent.
        range: points by distance from the sensor, bins of `RANGE_M`.
        boxes: by class and distance to the ego, bins of `DISTANCE_M`, the last open.
        visible: by visible fraction of the best agent, bins of `SHARE`.
        seen: boxes within 100 m of the ego seen by it, by a helper only, by nobody.
        labelled: share of the points with an object id.
        sources: works of others in the drive, see `sim.catalog.attribution`; none where its scenario is unknown.
    """

    drive: str
    sha256: str
    format: str
    frames: int
    sampled: list[int]
    seconds: float
    agents: dict[str, dict[str, str]]
    settings: dict[str, Any]
    points: list[int]
    range: list[int]
    boxes: dict[str, list[int]]
    visible: list[int]
    seen: dict[str, int]
    labelled: float
    sources: list[str]


class Card(msgspec.Struct, kw_only=True):
    """Data card: the content of `card.json`.

    Attributes:
        version: of this file.
        name: of the split.
        sha256: of the drives' digests; a card of other drives is written anew.
        frames, agent_frames: counts.
        agents: number of drives by their number of agents.
        connected_vehicles: whether an agent's list of vehicles holds other agents: yes, no, mixed or unknown.
        packages: versions of the packages that wrote the card.
        range_m, distance_m, share: edges of the histograms' bins.
        drives: one by one.
    """

    version: int
    name: str
    sha256: str
    frames: int
    agent_frames: int
    agents: dict[str, int]
    connected_vehicles: str
    packages: dict[str, str]
    range_m: list[float]
    distance_m: list[float]
    share: list[float]
    drives: list[DriveCard]


def write_card(split: Path, out: Path | None = None, pool: Pool = SERIAL) -> Path:
    """Write the data card of the drives at or below a folder; a card of the same drives is left as it is.

    Args:
        split: the folder, in any supported format.
        out: folder of the card; None for `SPLIT.card` beside it.

    Returns:
        The Markdown file.

    Raises:
        DataError: no drive is found, or one cannot be read.
    """
    split = Path(split).resolve()  # `.` and `..` have no name
    out = split.with_name(f"{split.name}.card") if out is None else Path(out)
    with pool.open() as executor:
        return describe(split, out, executor)


def describe(split: Path, out: Path, executor: Executor) -> Path:
    """Write a data card with workers that are open already; see `write_card`."""
    check_apart(out, split)
    check_folder(out)
    drives = list_drives(split)
    digest = hashlib.sha256("".join(open_drive(drive).digest() for drive in drives).encode()).hexdigest()
    if _is_of(out, digest):
        return out / "card.md"
    cards: list[DriveCard | None] = [None] * len(drives)
    for result in executor.run(_describe, [(split, drive) for drive in drives]):
        if result.error is not None:
            raise result.error
        cards[result.row] = result.value
    card = _whole(split.resolve().name, digest, [card for card in cards if card is not None])
    out.mkdir(parents=True, exist_ok=True)
    _draw(out, card)
    rows = np.unique(np.linspace(0, len(drives) - 1, min(_PICTURES, len(drives))).round().astype(int))
    pictures = []
    for row in rows.tolist():
        reader = open_drive(drives[row])
        middle, drive = len(reader) // 2, card.drives[row].drive
        title, file = f"{drive}, frame {reader.frames[middle]}", f"drive_{row}_frame_{reader.frames[middle]}.png"
        _draw_frame(out / file, reader.read(middle), title)
        pictures.append((file, title))
    write_file(out / "card.md", _markdown(card, pictures))
    # Last: it marks a complete card.
    write_file(out / "card.json", msgspec.json.format(encode_json(card), indent=1))
    return out / "card.md"


def _is_of(out: Path, digest: str) -> bool:
    try:
        card = read_json(out / "card.json", Card)
    except DataError:
        return False
    return (card.version, card.sha256) == (VERSION, digest)


def _describe(place: tuple[Path, Path], report: Progress) -> DriveCard:
    """Describe one drive; a task."""
    split, path = place
    reader = open_drive(path)
    rows = np.unique(np.linspace(0, len(reader) - 1, min(SAMPLES, len(reader))).round().astype(int)).tolist()
    frames = [reader.read(row) for row in rows]
    return DriveCard(
        drive=path.name if (below := path_below(split, path)) == Path() else below.as_posix(),
        sha256=reader.digest(),
        format=reader.format,
        frames=len(reader),
        sampled=[reader.frames[row] for row in rows],
        seconds=round(frames[-1].time_s - frames[0].time_s, 6) if frames else 0.0,
        agents=_agents(frames[0]) if frames else {},
        settings=_settings(own_settings(reader.protocol)),
        points=[len(agent.sweep) for frame in frames for agent in frame.agents],
        range=_sum([_ranges(frame) for frame in frames], len(RANGE_M) - 1),
        boxes={name: _sum([_boxes(frame, k) for frame in frames], len(DISTANCE_M)) for k, name in enumerate(CLASSES)},
        visible=_sum([_visible(frame) for frame in frames], len(SHARE) - 1),
        seen={name: sum(_seen(frame, value) for frame in frames) for name, value in SEEN_BY.items()},
        labelled=_labelled(frames),
        sources=_sources(own_settings(reader.protocol)),
    )


def _settings(own: dict) -> dict[str, Any]:
    scenario = own.get("scenario")
    keys = ("seed", "interval_s", "motion", "connected_vehicles", "visibility", "corruptions", "rendered", "proof")
    named = {"scenario": scenario["name"]} if isinstance(scenario, dict) and "name" in scenario else {}
    return {**named, **{key: own[key] for key in keys if key in own}}


def _sources(own: dict) -> list[str]:
    try:
        return list(attributions(msgspec.convert(own.get("scenario"), Scenario)))
    except msgspec.ValidationError:
        return []


def _agents(frame: Frame) -> dict[str, dict[str, str]]:
    specs = {agent.agent_id: agent.sweep.spec for agent in frame.agents}
    return {
        str(agent.agent_id): {"kind": agent.kind, "lidar": spec.name if (spec := specs[agent.agent_id]) else "unknown"}
        for agent in frame.agents
    }


def _sum(counts: Sequence[NDArray], bins: int) -> list[int]:
    return [int(n) for n in np.sum(counts, axis=0)] if counts else [0] * bins


def _ranges(frame: Frame) -> NDArray[Any]:
    norms = [np.linalg.norm(agent.sweep.points, axis=1) for agent in frame.agents]
    return np.histogram(np.concatenate([np.zeros(0), *norms]), RANGE_M)[0]


def _from_ego(frame: Frame) -> NDArray[Any]:
    """Return (N,) distances from the ego, the first agent; infinite for its own body."""
    ego = frame.agents[0]
    distance = np.linalg.norm(frame.truth.center[:, :2] - ego.world_from_body[:2, 3], axis=1)
    return np.where(frame.truth.object_id == ego.agent_id, np.inf, distance)


def _boxes(frame: Frame, label: int) -> NDArray[Any]:
    distance = _from_ego(frame)
    chosen = distance[(frame.truth.label == label) & np.isfinite(distance)]
    return np.histogram(chosen, [*DISTANCE_M, np.inf])[0]


def _visible(frame: Frame) -> NDArray[Any]:
    best = np.fmax.reduce(frame.visible_fraction, axis=0) if len(frame.agents) else np.zeros(0)
    return np.histogram(best[np.isfinite(best)], SHARE)[0]


def _seen(frame: Frame, value: int) -> int:
    near = _from_ego(frame) <= 100.0
    return int((frame.seen_by(frame.agents[0].agent_id)[near] == value).sum())


def _labelled(frames: Sequence[Frame]) -> float:
    points = sum(len(agent.sweep) for frame in frames for agent in frame.agents)
    on = sum(int((agent.sweep.object_id >= 0).sum()) for frame in frames for agent in frame.agents)
    return round(on / points, 4) if points else 0.0


def _whole(name: str, digest: str, drives: list[DriveCard]) -> Card:
    agents: dict[str, int] = {}
    for drive in drives:
        agents[str(len(drive.agents))] = agents.get(str(len(drive.agents)), 0) + 1
    listed = {drive.settings.get("connected_vehicles") for drive in drives}
    words = {True: "yes", False: "no", None: "unknown"}
    return Card(
        version=VERSION,
        name=name,
        sha256=digest,
        frames=sum(drive.frames for drive in drives),
        agent_frames=sum(drive.frames * len(drive.agents) for drive in drives),
        agents=dict(sorted(agents.items(), key=lambda item: int(item[0]))),
        connected_vehicles=words[listed.pop()] if len(listed) == 1 else "mixed",
        packages=dict.fromkeys(_PACKAGES, "not installed") | installed_versions(_PACKAGES),
        range_m=RANGE_M.tolist(),
        distance_m=DISTANCE_M.tolist(),
        share=SHARE.round(3).tolist(),
        drives=drives,
    )


def _markdown(card: Card, pictures: Sequence[tuple[str, str]]) -> str:
    points = np.array([n for drive in card.drives for n in drive.points])
    seen = {name: sum(drive.seen[name] for drive in card.drives) for name in SEEN_BY}
    total = max(1, sum(seen.values()))
    numbers = ", ".join(f"{count} with {number}" for number, count in card.agents.items())
    listed = {
        "yes": "An agent's list of vehicles holds the other agents' bodies too, which OPV2V leaves out.",
        "no": "An agent's list of vehicles leaves the other agents' bodies out, as OPV2V does.",
        "mixed": "Some drives list the other agents' bodies among an agent's vehicles, others do not.",
        "unknown": "It is unknown whether the other agents' bodies are among an agent's vehicles.",
    }[card.connected_vehicles]
    lines = [
        f"# {card.name}",
        "",
        f"Drives: {len(card.drives)}; frames: {card.frames}; sweeps: {card.agent_frames}. Drives by agents: {numbers}.",
        listed,
        f"Points per sweep: {_spread(points)}.",
        f"Of the boxes within 100 m of the ego {seen['ego'] / total:.0%} have points of the ego,"
        f" {seen['helper only'] / total:.0%} of a helper only, {seen['nobody'] / total:.0%} of nobody.",
        "",
        _drive_table(card).markdown(),
        f"Boxes by class and distance to the ego, in {sum(len(drive.sampled) for drive in card.drives)} frames:",
        "",
        _box_table(card).markdown(),
        "![Points by distance, boxes by distance, visible fraction](histograms.png)",
        "",
        *(f"![{title}]({file})" for file, title in pictures),
        "",
        *_terms(card),
        "Made with " + ", ".join(f"{name} {number}" for name, number in card.packages.items()) + ".",
        f"SHA-256 of the drives: `{card.sha256}`.",
    ]
    return "\n".join(lines) + "\n"


def _terms(card: Card) -> list[str]:
    """Return the section on the works of others that the drives are derived from."""
    drives_of: dict[str, list[str]] = {}
    for drive in card.drives:
        for source in drive.sources:
            drives_of.setdefault(source, []).append(drive.drive)
    if not drives_of:
        return []
    lines = [
        f"* {source}" + ("" if len(drives) == len(card.drives) else f" ({', '.join(drives)})")
        for source, drives in drives_of.items()
    ]
    return ["Works of others that the drives are derived from, to be named with them:", "", *lines, ""]


def _spread(points: NDArray) -> str:
    if not len(points):
        return "none"
    low, middle, high = np.percentile(points, [5, 50, 95]).round().astype(int)
    return f"{middle} ({low} to {high} in nine of ten)"


def _drive_table(card: Card) -> Table:
    columns = [Column("format", align="left"), Column("frames"), Column("seconds")]
    columns += [Column(head, align="left") for head in ("agents", "LiDARs", "points per sweep", "made by")]
    rows = []
    for drive in card.drives:
        lidars = ", ".join(sorted({agent["lidar"] for agent in drive.agents.values()}))
        kinds = [agent["kind"] for agent in drive.agents.values()]
        agents = f"{kinds.count('vehicle')} + {kinds.count('roadside')} roadside"
        made = (f"{key} {value}" for key, value in drive.settings.items() if isinstance(value, str | int | float))
        counts = drive.format, drive.frames, f"{drive.seconds:g}"
        words = agents, lidars, _spread(np.array(drive.points)), ", ".join(made) or "unknown"
        rows.append(TableRow(drive.drive, (*counts, *words)))
    return Table("drives", "", "drive", tuple(columns), tuple(rows))


def _box_table(card: Card) -> Table:
    low = DISTANCE_M.astype(int).tolist()
    heads = [f"{a} to {b} m" for a, b in pairwise(low)] + [f"over {low[-1]} m"]
    counts = {name: np.sum([drive.boxes[name] for drive in card.drives], axis=0) for name in CLASSES}
    rows = tuple(TableRow(name, tuple(of_class.tolist())) for name, of_class in counts.items())
    return Table("boxes", "", "class", tuple(map(Column, heads)), rows)


def _draw(out: Path, card: Card) -> None:
    from dsrc.tables.figure import COLORS, figure_style, panels, write_figure

    with figure_style():
        figure, (points, boxes, shares) = panels(13.0, 3.6, columns=3)
        middle = 0.5 * (RANGE_M[1:] + RANGE_M[:-1])
        points.bar(middle, np.sum([drive.range for drive in card.drives], axis=0), width=4.5, color=COLORS[0])
        points.set(xlabel="distance from the sensor, m", ylabel="points", yscale="symlog")
        base = np.zeros(len(DISTANCE_M))
        for name, color in zip(CLASSES, COLORS, strict=False):
            counts = np.sum([drive.boxes[name] for drive in card.drives], axis=0)
            boxes.bar(np.arange(len(base)), counts, bottom=base, color=color, label=name)
            base = base + counts
        boxes.set_xticks(np.arange(len(base)), [*(f"{low:.0f}" for low in DISTANCE_M)])
        boxes.set(xlabel="distance to the ego, m, from", ylabel="boxes")
        boxes.legend(fontsize=7)
        visible = np.sum([drive.visible for drive in card.drives], axis=0)
        shares.bar(0.5 * (SHARE[1:] + SHARE[:-1]), visible, width=0.09, color=COLORS[0])
        shares.set(xlabel="visible fraction, best agent", ylabel="boxes")
    write_figure(out / "histograms.png", figure, {"sha256": card.sha256}, dpi=110)


def _draw_frame(path: Path, frame: Frame, title: str) -> None:
    """Draw a frame in bird's eye view: points in the colour of their agent, boxes black where an agent has points."""
    from dsrc.tables.figure import COLORS, figure_style, panels, write_figure

    ego = frame.agents[0].world_from_body[:2, 3]
    with figure_style():
        figure, (axes,) = panels(7.0, 7.4)
        for number, agent in enumerate(frame.agents):
            xy = agent.sweep.world_points[:, :2] - ego
            xy = xy[np.max(np.abs(xy), axis=1) < _VIEW_M][::3]
            color = COLORS[number % len(COLORS)]
            axes.plot(*xy.T, ",", color=color, alpha=0.5, rasterized=True)
            place = agent.world_from_body[:2, 3] - ego
            name = f"{'ego' if number == 0 else agent.kind} {agent.agent_id}"
            marker = "^" if agent.kind == "vehicle" else "s"
            axes.plot(*place, marker, color=color, markeredgecolor="black", zorder=3, label=name)
        seen = frame.points_on.sum(axis=0) > 0
        for points, corners in zip(seen, frame.truth.corners()[:, :4, :2] - ego, strict=True):
            if float(np.abs(corners).max()) < _VIEW_M:
                axes.fill(*corners.T, fill=False, color=_SEEN if points else _UNSEEN, linewidth=0.8)
        for color, meaning in ((_SEEN, "box with points of an agent"), (_UNSEEN, "box without")):
            axes.plot([], [], color=color, linewidth=0.8, label=meaning)
        figure.legend(loc="outside lower center", ncols=4, fontsize=8)
        limits = (-_VIEW_M, _VIEW_M)
        axes.set(xlim=limits, ylim=limits, aspect="equal", title=title, xlabel="m", ylabel="m")
        axes.grid(visible=False)
    write_figure(path, figure, {"frame": title}, dpi=110)
