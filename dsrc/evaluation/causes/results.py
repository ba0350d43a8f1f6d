"""Causes of all errors of an evaluation: `causes.csv`, an error a line, and tables of them by method and condition."""

import csv
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dsrc.data.drives import Drive
from dsrc.data.sample import DetectorSettings, SampleRequest, participants
from dsrc.evaluation.cache import read_cell
from dsrc.evaluation.causes.cause import FALSE, MISSED, Circumstances, frame_causes
from dsrc.evaluation.cells import drive_of
from dsrc.evaluation.config import Case
from dsrc.evaluation.detect import FrameHistory, MethodResult, receiver_of
from dsrc.evaluation.detection_table import DetectionTable
from dsrc.evaluation.listener import lies_in, misplaced
from dsrc.evaluation.runner import CaseResult, TrainedDetector
from dsrc.evaluation.stress import IOU, SURE
from dsrc.faults.condition import faults_of
from dsrc.models.channel import Receiver
from dsrc.tables.files import Scalar, csv_text
from dsrc.tables.table import Column, Table, TableRow
from sensors.corruptions import CLEAN, drive_seed
from sim.files import write_file
from sim.radio import IDEAL, Radio

FILE = "causes.csv"
_AT_ONCE = Radio.parse(IDEAL).spec().decisive()
_COLUMNS = (
    *("method", "condition", "drive", "frame", "position", "error", "kind", "object_id", "rank", "score", "iou"),
    *("distance_m", "points", "points_left", "hidden_from", "hidden_by", "helper", "sentence"),
)


def write_causes(
    out: Path, made_by: Mapping[str, object], entries: Sequence[tuple[CaseResult, TrainedDetector]], seed: int
) -> None:
    """Write `causes.csv` of results, at the score and the overlap of `dsrc stress`; each frame is read once.

    Args:
        entries: results and their detectors, by condition and method.
        seed: of the corruptions.

    Raises:
        DataError: a cell or a frame is damaged.
    """
    records: dict[int, list[dict[str, Scalar]]] = defaultdict(list)
    wrong: dict[tuple[Path, int], list[tuple[int, DetectionTable]]] = defaultdict(list)
    for number, (entry, _) in enumerate(entries):
        for key, path in zip(entry.cells, entry.drives, strict=True):
            result = read_cell(out / "cells", key)
            for table, bad in zip(result.table.frames(), _with_errors(result), strict=True):
                if bad:
                    wrong[path, int(table.position[0])].append((number, table))
    receivers: dict[tuple[Path, int], Receiver | None] = {}
    for (path, position), tables in sorted(wrong.items()):
        drive = drive_of(path)
        past = FrameHistory(drive.read, position)
        frame = past[0]
        teams: dict[tuple[SampleRequest, int], tuple[int, ...]] = {}
        for number, table in tables:
            (entry, trained), condition = entries[number], entries[number][0].case.condition
            request, alone = trained.settings.request, entry.case.agents or trained.agents
            asked = request, int(table.ego_id[0])
            if asked not in teams:
                teams[asked] = tuple(frame.agents[one].agent_id for one in participants(frame, asked[1], request))
            team = teams[asked][:alone]
            if (path, number) not in receivers:
                receivers[path, number] = _receiver(drive, team, entry.case, trained.settings, seed)
            receiver = receivers[path, number]
            links = () if receiver is None else receiver.links(past, position, team[0], team[1:])
            own_seed = drive_seed(seed, drive.drive.name)
            ages = {link.sender: link.age_s if link.received else None for link in links}
            known = Circumstances(
                "" if condition.kind == CLEAN else condition.label,
                None if condition.kind == CLEAN else misplaced(condition.apply(frame, own_seed), condition, own_seed),
                team,
                request.judged_m,
                ages,
                lies_in(frame, condition, own_seed, team[1:], ages),
            )
            for cause in frame_causes(table, frame, SURE, IOU, known):
                made: dict[str, Any] = msgspec.structs.asdict(cause)
                box = table.truth if cause.error == "missed" else table.boxes
                row = cause.rank if cause.error == "false" else int(np.argmax(table.object_id == cause.object_id))
                lists = {name: " ".join(map(_text, made[name])) for name in ("hidden_from", "hidden_by")}
                place: dict[str, Scalar] = {"drive": path.name, "frame": frame.index, "position": position}
                distance = {"distance_m": round(float(np.hypot(*box[row, :2])), 2)}
                who = {"method": entry.case.method, "condition": condition.label}
                records[number].append({**who, **place, **distance, **made, **lists})
    lines = [record for number in range(len(entries)) for record in records[number]]
    write_file(out / FILE, csv_text(lines, _COLUMNS, made_by))


def _receiver(drive: Drive, team: Sequence[int], case: Case, settings: DetectorSettings, seed: int) -> Receiver | None:
    """Receiver of a case in a drive; None where all messages arrive at once."""
    spec, condition = case.spec(), case.condition
    if len(team) == 1 or (spec.decisive() == _AT_ONCE and not any(fault.radio for fault in faults_of(condition))):
        return None
    return receiver_of(drive, team[0], condition, spec, settings, seed)


def _text(number: int | None) -> str:
    return "-" if number is None else str(number)  # -1 is a roadside unit


def cause_tables(out: Path) -> list[Table]:
    """Tables of missed objects and of false boxes by cause, of a folder with `causes.csv`; empty without errors."""
    with (out / FILE).open(encoding="utf-8", newline="") as file:
        file.readline()
        lines = list(csv.DictReader(file))
    tables = []
    for error, title, kinds in (("missed", "Misses by cause", MISSED), ("false", "False boxes by cause", FALSE)):
        counts = Counter((line["condition"], line["method"], line["kind"]) for line in lines if line["error"] == error)
        if counts:
            tables.append(_table(error, f"{title}, score ≥ {SURE:g}, IoU ≥ {IOU:g}", kinds, counts))
    return tables


def _table(name: str, title: str, kinds: Iterable[str], counts: Counter[tuple[str, str, str]]) -> Table:
    shown = [kind for kind in kinds if any(kind == known for _, _, known in counts)]
    cases = list(dict.fromkeys((condition, method) for condition, method, _ in counts))
    rows = []
    for condition, method in cases:
        own = [counts[condition, method, kind] for kind in shown]
        rows.append(TableRow(condition, (method, float(sum(own)), *map(float, own))))
    columns = (Column("method", align="left"), Column("all"), *map(Column, shown))
    return Table(name, title, "condition", columns, tuple(rows), grouped=True)


def _with_errors(result: MethodResult) -> list[bool]:
    """Whether each frame has a missed object or a false box."""
    matches = result.matches
    frame = np.repeat(np.arange(matches.frames), matches.detection_counts)
    sure, right = matches.score >= SURE, matches.matched["bev", IOU] >= 0
    found, false = (np.bincount(frame[sure & one], minlength=matches.frames) for one in (right, ~right))
    return [bool(one) for one in (found < matches.truth_counts) | (false > 0)]
