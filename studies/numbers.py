"""The numbers that the pages quote, from the committed result files.

A page quotes a number between `<!--n:NAME-->` and `<!--/n-->`; this writes `studies/numbers.json` and the pages anew.

Usage:
    python -m studies.numbers
"""

import argparse
import csv
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.metrics.comparison import Value, arrived, collided, counted, pairs
from dsrc.closed_loop.metrics.statistics import PairedRates, paired_rates, rate
from dsrc.closed_loop.report.tables import parts_of, tables
from dsrc.closed_loop.types import Outcome
from dsrc.training.recipes import RECIPES
from studies.closed_loop.page import committed
from studies.dsrc_paper.published import published_tables
from studies.rivals.questions import TAUGHT

ROOT = Path(__file__).parents[1]
FILE = ROOT / "studies/numbers.json"
PAGES = ("README.md", "docs/results.md", "docs/closed_loop.md", "docs/campaigns.md", "docs/closed_loop_results.md")
REPORT = ROOT / "studies/dsrc_paper/report"
RIVALS = ROOT / "studies/rivals/report"
LOOP = ROOT / "studies/closed_loop"
QUOTED = re.compile(r"<!--n:(\w+)-->(.*?)<!--/n-->")
_PACE = {
    "safe": "all arrive",
    "s": "arrives, s",
    "later": "less the first",
    "brake": "hardest braking, m/s²",
    "harsh": "harsh",
}
ALL_PARTS = "SDD + PCP + REC"
FEATURES = (
    *("F-Cooper", "AttFuse (plain student)", "V2VNet", "V2X-ViT", "CoBEVT"),
    *("Where2comm", "CoAlign", "ERMVP", "MRCNet-style", "DSRC"),
)
"""Methods that share features."""
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")
DRIVERS = ("", "anticipating", "evading")
"""Drivers as labels of perceptions name them, the default one by nothing."""
TEAM, PLAIN, ALONE = "DSRC", "plain student", "ego alone"


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    found = numbers()
    FILE.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for page in PAGES:
        path = ROOT / page
        path.write_text(quoting(path.read_text(encoding="utf-8"), found), encoding="utf-8")
        print(path)


def quoting(text: str, found: Mapping[str, str]) -> str:
    """Return a page with its quoted numbers as they are in the results.

    Raises:
        KeyError: the page quotes an unknown number.
    """
    return QUOTED.sub(lambda match: f"<!--n:{match[1]}-->{found[match[1]]}<!--/n-->", text)


def numbers() -> dict[str, str]:
    """Return every number by its name, as pages quote it."""
    return dict(
        [
            *_counts(),
            *_schedules(),
            *_differences(),
            *_thresholds(),
            *_snow(),
            *_average_precision(),
            *_ranks(),
            *_demo(),
            *_driving(),
            *_cooperation(),
            *_faulty(),
            *_real(),
        ]
    )


def _rows(file: Path) -> list[dict[str, str]]:
    lines = file.read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))  # of the provenance


def _made_by(file: Path) -> dict[str, Any]:
    """Return the settings that a result file was made with."""
    return json.loads(file.read_text(encoding="utf-8").partition("\n")[0].lstrip("# "))["settings"]


def _counts() -> Iterator[tuple[str, str]]:
    """Yield how many drives, places, frames, trainings and seeds the other numbers are of."""
    results = REPORT / "dsrc-sim-twins/results.csv"
    drives = _made_by(results)["datasets"]["dsrc-sim"]
    twins = _rows(results)
    yield "test_drives", str(len(drives))
    yield "test_places", str(len({drive.rpartition("_")[0] for drive in drives}))
    yield "frames_twins", _only({row["frames"] for row in twins})
    yield "frames_small", _only({row["frames"] for row in _rows(REPORT / "dsrc-sim-small/results.csv")})
    yield "trainings", str(len({row["training"] for row in twins}))
    yield "frames_snow", str(_made_by(REPORT / "snow.csv")["frames"])
    parts = _rows(RIVALS / "parts/results.csv")
    yield "frames_parts", _only({row["frames"] for row in parts})
    yield "trainings_parts", _only({str(count) for count in _trainings(parts).values()})
    boxes = {place: int(row["boxes"]) for place, row in _table("places_twins").items()}
    whole = boxes.pop("all, by drive")
    busiest = sorted(boxes[place] for place in boxes if not place.startswith("all"))[-2:]
    yield "busy_places_boxes", f"{100.0 * sum(busiest) / whole:.0f} %"
    main, eyes = _episodes("campaign"), _episodes("cooperation-detectors")
    yield "seeds_corrupted", str(len({one.seed for one in _of(main, ALONE, corrupted=True)}))
    yield "seeds_cooperation", str(len({one.seed for one in eyes}))
    yield "encounters_cooperation", str(len({one.scenario for one in eyes}))


def _schedules() -> Iterator[tuple[str, str]]:
    """Yield the steps of the twins, of the teacher that they start from and of rivals' layers, and the grid's range."""
    trained = {row["name"]: row for row in _rows(REPORT.parent / "trainings.csv")}
    chain = [trained["attfuse_s0"]]
    while start := chain[-1]["init"]:
        chain.append(trained[start])
    taught = next(row for row, one in enumerate(chain) if one["name"] == "teacher")
    for name, part in (("twins", chain[:taught]), ("teacher", chain[taught:])):
        yield f"steps_{name}", f"{sum(int(one['steps']) for one in part):,}"
    yield "steps_rivals", f"{int(trained['v2x-vit_s0']['steps']):,}"
    x0, y0, _, x1, y1, _ = RECIPES["small"]().model.grid.range_m
    yield "range_twins", f"{x1 - x0:.0f} m x {y1 - y0:.0f} m"


def _trainings(rows: Sequence[Mapping[str, str]]) -> dict[str, int]:
    """Return the number of trainings of each method."""
    found: dict[str, set[str]] = {}
    for row in rows:
        found.setdefault(row["method"], set()).add(row["training"])
    return {method: len(trainings) for method, trainings in found.items()}


def _only(values: set[str]) -> str:
    (value,) = values
    return value


def _differences() -> Iterator[tuple[str, str]]:
    """Yield differences of AP between trainings, points at 0.5 / 0.7, with the interval of 95 % over drives."""
    small, twins = REPORT / "dsrc-sim-small/dsrc-sim", REPORT / "dsrc-sim-twins/dsrc-sim"
    plain, taught = "AttFuse (plain student)", "DSRC, corrupted clouds"
    for name, file, method, baseline, condition in (
        ("helpers_gain", REPORT / "helpers/dsrc-sim/differences.csv", "DSRC", "DSRC, ego alone", "clean"),
        ("gain_clean", twins / "differences.csv", "DSRC", plain, "clean"),
        ("gain_ours", twins / "differences.csv", "DSRC", plain, "mean_corrupted"),
        ("gain_published", twins / "differences_paper.csv", "DSRC", plain, "mean_corrupted"),
        ("late_snow", small / "differences.csv", "DSRC", "Late", "snow"),
        ("taught_snow", small / "differences.csv", taught, "DSRC", "snow"),
        ("taught_clean", small / "differences.csv", taught, "DSRC", "clean"),
        ("taught_clean_plain", small / "differences.csv", "AttFuse, corrupted clouds", plain, "clean"),
    ):
        wanted = (method, baseline, condition)
        rows = [row for row in _rows(file) if (row["method"], row["baseline"], row["condition"]) == wanted]
        yield name, " / ".join(_interval(row) for row in rows)
        counts, common = _trainings(_rows(file.parents[1] / "results.csv")), len(rows[0]["seeds"].split())
        pair = [common] if common > 1 else dict.fromkeys(counts[one] for one in (method, baseline))
        yield f"{name}_trainings", " and ".join(map(str, pair))
    for row in _rows(RIVALS / "parts/dsrc-sim-2/differences_paper.csv"):
        twins = {("DSRC", "plain twin"): "alone", (f"DSRC, {TAUGHT}", f"plain twin, {TAUGHT}"): "taught"}
        start = twins.get((row["method"], row["baseline"]))
        if start and row["condition"] == "mean_corrupted":
            yield f"parts_{start}_{row['iou'].replace('.', '')}", f"{100.0 * float(row['difference']):+.1f}"


def _interval(row: Mapping[str, str]) -> str:
    """Return a difference in points with its interval by drive; a bound near 0 has the digit that tells its side."""
    value, *bounds = (100.0 * float(row[key]) for key in ("difference", "by_drive_low", "by_drive_high"))
    low, high = (f"{bound:.2f}" if f"{abs(bound):.1f}" == "0.0" else f"{bound:.1f}" for bound in bounds)
    return f"{value:+.1f} [{low}, {high}]"


def _thresholds() -> Iterator[tuple[str, str]]:
    """Yield the gain of DSRC with detections sorted inside frames, by the score from which boxes count."""
    cells = _table("score_thresholds_twins")
    for name, title, score in (
        ("inside_clean_from_02", "clean", "0.2"),
        ("inside_clean_from_025", "clean", "0.25"),
        ("inside_published_from_02", "mean of the corruptions as published", "0.2"),
        ("inside_published_from_025", "mean of the corruptions as published", "0.25"),
        ("inside_published_from_03", "mean of the corruptions as published", "0.3"),
    ):
        yield name, " / ".join(_plain(cells[f"{title}, {iou}"][score]) for iou in (0.5, 0.7))
    by_place = _table("places_twins")["all, by place"]
    if not all(by_place[title].count("**") == 4 for title in by_place if title.startswith("mean")):
        raise ValueError("places_twins: a mean of the corruptions is not resolved over places; the page says so")


def _table(name: str) -> dict[str, dict[str, str]]:
    """Return the rows of a table in the report on the paper, by their first cells."""
    page = (REPORT.parent / "report.md").read_text(encoding="utf-8")
    block = page.partition(f"<!-- begin {name} -->\n")[2].partition("\n<!-- end")[0]
    head, _, *lines = (line.strip("| ").split(" | ") for line in block.splitlines())
    return {line[0]: dict(zip(head[1:], line[1:], strict=True)) for line in lines}


def _plain(cell: str) -> str:
    """Return a cell without stars, and bounds without the sign of a positive one."""
    return cell.replace("*", "").replace("[+", "[").replace(", +", ", ")


def _snow() -> Iterator[tuple[str, str]]:
    """Yield AP at 0.5 / 0.7 in our snow, alone and with helpers, and the gains at 0.5."""
    every = _rows(REPORT / "snow.csv")
    rows = [row for row in every if row["detector"] == "small-dsrc"]
    (taught,) = (row for row in every if row["line"] == "**snow, ours**" and row["detector"] == "small-dsrc-corrupted")
    yield "snow_taught_gain", _team_gain(taught)
    whole, dropped = (
        {(row["condition"], row["detector"]): float(row["team_0.5"]) for row in every if row["use"] == use}
        for use in ("", "drop_lone_points True")
    )
    for name, condition in (("clear", "clean"), ("cross", "cross sensor 3")):
        costs = sorted(round(whole[key] - dropped[key]) for key in dropped if key[0] == condition)
        yield f"dropped_cost_{name}", f"{costs[0]} to {costs[-1]}"
    first = next(place for place, row in enumerate(rows) if row["line"] == "**snow, ours**")
    for name, row in zip(("snow", "dropped"), rows[first:], strict=False):
        if row["condition"] != "snow 3" or (row["use"] == "drop_lone_points True") != (name == "dropped"):
            raise ValueError("snow.csv: the lines of our snow are others")
        for who in ("alone", "team"):
            yield f"{name}_{who}", " / ".join(f"{float(row[f'{who}_{iou}']):.1f}" for iou in (0.5, 0.7))
        yield f"{name}_gain", _team_gain(row)


def _team_gain(row: Mapping[str, str]) -> str:
    gain = float(row["team_0.5"]) - float(row["alone_0.5"])
    return f"{gain:+.1f} [{float(row['low']):.1f}, {float(row['high']):.1f}]"


def _average_precision() -> Iterator[tuple[str, str]]:
    """Yield AP at 0.5 / 0.7 of clean frames, mean of the trainings: alone, with helpers, with errors of the poses."""
    for row in _rows(REPORT / "helpers/dsrc-sim/choice.csv"):
        name = {"DSRC": "ap_team", "DSRC, ego alone": "ap_alone"}[row["Method"]]
        yield name, " / ".join(f"{100.0 * float(row[f'AP@{iou}']):.1f}" for iou in (0.5, 0.7))
    folder = REPORT / "dsrc-sim-sweeps/dsrc-sim"
    for name, file, method, value in (
        ("ap_poses", "pose_error.csv", "DSRC", "0.4"),
        ("ap_poses_plain", "pose_error.csv", "AttFuse (plain student)", "0.4"),
    ):
        (row,) = (row for row in _rows(folder / file) if row["Method"] == method)
        yield name, " / ".join(f"{100.0 * float(row[f'{value} {iou}']):.1f}" for iou in (0.5, 0.7))


def _ranks() -> Iterator[tuple[str, str]]:
    """Yield the paper's own gain, and which rank DSRC has by mCE of those that share features, for both families."""
    none, whole = (row.cells[0] for row in published_tables()["table_2"].rows if row.label in ("none", ALL_PARTS))
    yield "paper_gain", " / ".join(f"{100.0 * (b.mean - a.mean):+.1f}" for a, b in zip(none, whole, strict=True))
    ranks = []
    for file in ("table_1.csv", "table_1_paper.csv"):
        rows = {row["Method"]: row for row in _rows(REPORT / "dsrc-sim-small/dsrc-sim" / file)}
        for iou in (0.5, 0.7):
            lost = sorted(FEATURES, key=lambda name: float(rows[name][f"mCE {iou}"]))
            ranks.append(lost.index("DSRC"))
            if float(rows["Late"][f"mCE {iou}"]) >= float(rows[lost[0]][f"mCE {iou}"]):
                raise ValueError(f"{file}: late fusion no longer loses least; the page says so")
    yield "mce_ranks", " to ".join(dict.fromkeys(ORDINALS[rank] for rank in (min(ranks), max(ranks))))
    yield "mce_rivals", str(len(FEATURES))


def _demo() -> Iterator[tuple[str, str]]:
    """Yield the mean AP at 0.5 / 0.7 of the demo's drive, from the results.csv that it writes."""
    methods = {
        "DSRC (SDD+PCP+REC)": "dsrc",
        "plain student": "plain",
        "DSRC, corrupted clouds": "corrupted",
        "DSRC (SDD+PCP+REC), ego alone": "alone",
    }
    for row in _rows(ROOT / "studies/shipped/demo.csv"):
        if row["condition"] == "mean_ap":
            yield (
                f"demo_{methods[row['method']]}",
                " / ".join(f"{100.0 * float(row[f'ap_bev_{k}']):.1f}" for k in (50, 70)),
            )


def _episodes(plan: str) -> list[EpisodeResult]:
    return parts_of(committed(LOOP / f"{plan}.toml")[1])[0]


def _driving() -> Iterator[tuple[str, str]]:
    """Yield crashes and arrivals of the campaigns."""
    main, people, traffic, opened = map(_episodes, ("campaign", "vulnerable", "traffic", "no-occluder"))
    for name, eyes in (("alone", ALONE), ("team", TEAM), ("plain", PLAIN)):
        clean = _of(main, eyes, corrupted=False)
        yield f"crash_{name}", f"{_share(clean)} [{', '.join(_bounds(clean))}]"
        yield f"crash_{name}_percent", f"{_percent(clean)} ({' to '.join(_bounds(clean))})"
        yield f"crash_{name}_corrupted", _share(_of(main, eyes, corrupted=True))
        yield f"crash_{name}_corrupted_percent", _percent(_of(main, eyes, corrupted=True))
        snow = [one for one in _of(main, eyes, corrupted=True) if one.corruption == "snow"]
        yield f"crash_{name}_snow", f"{_share(snow)} [{', '.join(_bounds(snow))}]"
    for name, episodes in (("people", people), ("traffic", traffic), ("open", opened)):
        for who, eyes in (("alone", ALONE), ("team", TEAM)):
            yield f"{name}_{who}", _count(_of(episodes, eyes, corrupted=False))
    team, plain = (_of(main, eyes, corrupted=True) for eyes in (TEAM, PLAIN))
    yield "arrive_team_plain", _compared(team, plain, arrived)
    yield "crash_team_plain", _compared(team, plain, collided)


def _of(episodes: Sequence[EpisodeResult], eyes: str, *, corrupted: bool) -> list[EpisodeResult]:
    chosen = [one for one in episodes if one.perception == eyes and (one.corruption != "clean") is corrupted]
    return counted(chosen)


def _count(met: Sequence[EpisodeResult]) -> str:
    return f"{sum(map(collided, met)):.0f} of {len(met)}"


def _percent(met: Sequence[EpisodeResult]) -> str:
    return f"{100.0 * rate([collided(one) for one in met]).value:.0f} %"


def _share(met: Sequence[EpisodeResult]) -> str:
    return f"{_count(met)}, {_percent(met)}"


def _bounds(met: Sequence[EpisodeResult]) -> list[str]:
    """Return the bounds of the Wilson interval of 95 % of the crashes, %."""
    found = rate([collided(one) for one in met])
    return [f"{100.0 * bound:.0f}" for bound in (found.low, found.high)]


def _compared(ours: Sequence[EpisodeResult], theirs: Sequence[EpisodeResult], value: Value) -> str:
    """Return in how many pairs of episodes only one side has an event, with the exact test by encounter and seed."""
    matched = pairs(ours, theirs)
    clusters = [(one.scenario, one.seed) for one, _ in matched]
    found = paired_rates(*([value(pair[side]) for pair in matched] for side in (0, 1)), clusters=clusters)
    return f"{found.only_first} against {found.only_second} of {len(matched)}, {_chance(found)}"


def _chance(found: PairedRates) -> str:
    return "p < 0.001" if found.p_value < 0.001 else f"p = {found.p_value:.3f}"


def _cooperation() -> Iterator[tuple[str, str]]:
    """Yield what eyes give to a driver: crashes, and time and braking where it arrives with all of its eyes.

    `_against`: crashes of one side only, in pairs with the driver's first eyes; `_encounters`: those with a crash;
    `_unknown`: crashes in encounters with a class that the detector lacks; `_all`: those and all others; `_elsewhere`:
    without `eebl_chain`, where most crashes of who anticipates are; `_kbps`: what helpers send, kB/s.
    Eyes without a name are the first of their campaign alone, since another one yields their numbers.
    """
    for plan, eyes in (
        ("cooperation", {"sight": "own sight", "team_sight": "team's sight"}),
        ("cooperation-detectors", {"ego": "ego", "team": "team", "late": "late"}),
        ("cooperation-boxes", {"": "late", "cpm": "cpm"}),
        ("cooperation-mined", {"mined_sight": "own sight", "mined_team_sight": "team's sight"}),
        ("cooperation-mined-detectors", {"mined_ego": "ego", "mined_team": "team", "mined_late": "late"}),
        ("redundancy", {"": "cpm", "cpm_dynamics": "cpm-dynamics", "cpm_distance": "cpm-distance"}),
    ):
        result = committed(LOOP / f"{plan}.toml")[1]
        pace, (common, apart) = tables(result).get("pace"), parts_of(result)
        heads = [column.title for column in pace.columns] if pace else []
        rows = {row.label: dict(zip(heads, map(str, row.cells), strict=True)) for row in (pace.rows if pace else ())}
        first, *_ = eyes.values()
        for driver in DRIVERS:
            more = f", {driver}" if driver else ""
            for name, perception in eyes.items():
                label = f"{perception}{more}"
                met = counted([one for one in common if one.perception == label])
                if not name or not met:
                    continue
                key = f"{name}_{driver}" if driver else name
                yield f"{key}_crash", _count(met)
                if unknown := [one for one in apart if one.perception == label]:
                    crashed = sum(one.outcome == Outcome.CRASHED for one in unknown)
                    yield f"{key}_unknown", f"{crashed} of {len(unknown)}"
                    every = counted([one for one in result.results if one.perception == label])
                    yield f"{key}_all", _count(every)
                    if perception != first:
                        theirs = [one for one in result.results if one.perception == f"{first}{more}"]
                        yield f"{key}_against_all", _compared(every, theirs, collided)
                elsewhere = [one for one in met if one.scenario != "eebl_chain"]
                if fewer := len(elsewhere) < len(met):
                    yield f"{key}_elsewhere", _count(elsewhere)
                places = {one.scenario for one in met if collided(one)}
                yield f"{key}_encounters", f"{len(places)} of {len({one.scenario for one in met})}"
                if perception != first:
                    theirs = [one for one in common if one.perception == f"{first}{more}"]
                    yield f"{key}_against", _compared(met, theirs, collided)
                    if fewer:
                        yield f"{key}_against_elsewhere", _compared(elsewhere, theirs, collided)
                sent, lasted = (sum(one.metrics[what] or 0.0 for one in met) for what in ("sent_mb", "duration_s"))
                yield f"{key}_kbps", f"{1e3 * sent / lasted:.3g}"
                if label in rows:
                    yield from ((f"{key}_{field}", rows[label][head]) for field, head in _PACE.items())
                    yield f"{key}_brake_mean", rows[label][_PACE["brake"]].partition(" ")[0]


def _points(found: PairedRates) -> str:
    """Return a difference of shares in points, with its interval of 95 % and its exact test."""
    value, low, high = (
        f"{100.0 * one:.0f}" for one in (found.difference.value, found.difference.low, found.difference.high)
    )
    return f"{value} [{low}, {high}], {_chance(found)}"


def _faulty() -> Iterator[tuple[str, str]]:
    """Yield crashes and arrivals of each driver under the composed fault and in the same episodes without it.

    `_less` and `_arrivals_less`: crashes and arrivals under it, less those of the ego alone; `_harm` and `_arrivals`:
    crashes and arrivals with it, less those without it.
    """
    common = parts_of(committed(LOOP / "cooperation-faults.toml")[1])[0]
    for eyes in ("ego", "team", "late"):
        for driver in DRIVERS:
            label = f"{eyes}, {driver}" if driver else eyes
            own = [one for one in common if one.perception == label]
            key = f"faulty_{eyes}_{driver}" if driver else f"faulty_{eyes}"
            yield f"{key}_clean", _count(counted([one for one in own if one.clean]))
            yield f"{key}_crash", _count(counted([one for one in own if not one.clean]))
            for what, clean in (("arrived_clean", True), ("arrived", False)):
                met = counted([one for one in own if one.clean == clean], failed=True)
                yield f"{key}_{what}", f"{sum(map(arrived, met)):.0f} of {len(met)}"
                speed = what.replace("arrived", "speed")
                yield f"{key}_{speed}", f"{sum(one.metrics['mean_speed_mps'] or 0.0 for one in met) / len(met):.1f}"
            alone = {
                (one.scenario, one.seed): one
                for one in common
                if one.perception == (f"ego, {driver}" if driver else "ego") and not one.clean
            }
            before = {(one.scenario, one.seed): one for one in own if one.clean}
            for what, others, value in (
                ("less", alone, collided),
                ("arrivals_less", alone, arrived),
                ("harm", before, collided),
                ("arrivals", before, arrived),
            ):
                if others is alone and eyes == "ego":
                    continue
                both = [(one, others[one.scenario, one.seed]) for one in own if not one.clean]
                places = [(one.scenario, one.seed) for one, _ in both]
                sides = ([value(pair[side]) for pair in both] for side in (0, 1))
                yield f"{key}_{what}", _points(paired_rates(*sides, clusters=places))


def _real() -> Iterator[tuple[str, str]]:
    """Yield what a shipped detector finds in real frames and in simulated ones."""
    rows = {(row["detector"], row["clouds"]): row for row in _rows(ROOT / "studies/shipped/real_frames.csv")}
    real, ours = rows["small-plain", "real"], rows["small-plain", "simulated, HDL-64E"]
    road = rows["road-dsrc", "real, five of the 17"]
    yield "real_frames", real["frames"]
    yield "real_recall", f"{real['recall_percent']} %"
    yield "simulated_recall", f"{ours['recall_percent']} %"
    yield "real_vehicles", real["vehicles"]
    yield "road_frames", road["frames"]
    yield "road_vehicles", road["vehicles"]
    small = rows["small-plain", "real, five of the 17, height auto"]
    yield "road_small_recall", f"{small['recall_percent']} %"
    yield "road_false", f"{road['false_boxes_per_frame']} and {small['false_boxes_per_frame']}"
    yield "road_recall", f"{road['recall_percent']} %"


if __name__ == "__main__":
    main()
