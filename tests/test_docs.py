"""Docs: no link leads nowhere, and the tutorials run as they are written."""

import csv
import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
from collections import Counter
from pathlib import Path
from urllib.parse import unquote

import msgspec
import numpy as np
import pytest
import torch
from PIL import Image

from dsrc.cli.demo import SCENARIO, TEST_SEED
from dsrc.cli.main import COMMANDS, command_class, run
from dsrc.cli.options import parse
from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.plan import episodes_of
from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.metrics.comparison import Value, arrived, avoidable, collided, counted, pairs
from dsrc.closed_loop.metrics.statistics import paired_rates
from dsrc.closed_loop.report.report import markdown, sections
from dsrc.closed_loop.report.tables import parts_of
from dsrc.closed_loop.types import Outcome
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.evaluation.metrics.protocols import PROTOCOLS
from dsrc.evaluation.scoring.truth import truth_of_frame
from dsrc.models.compression import message_bytes
from dsrc.models.fusion import FUSIONS
from dsrc.training.recipes import METHODS, of_method, opv2v, small
from sensors.corruptions.check import example_frame
from tests.commands import run_script
from tests.dsrc.data.toy import toy_frame
from tests.dsrc.evaluation.small import write_detector, write_drives
from tests.dsrc.models.storage.opencood_networks import network
from tests.paths import ROOT
from tests.test_readme import commands_of

PAGES = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "examples/*.md", "benchmarks/*.md", "scenarios/**/*.md")
    for path in ROOT.glob(pattern)
    if "_site" not in path.parts
)
TUTORIALS = [
    ROOT / "docs/tutorials" / f"{name}.md"
    for name in (ROOT / "docs/tutorials/index.md").read_text().split("```")[1].split("\n\n")[1].split()
]


def prose(page: Path) -> str:
    """Return the text of a page without its code."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`\n]*`", "`code`", text)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and myst-parser make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    titles = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title) for title in re.findall(r"^#+ (.+)$", text, re.MULTILINE)]
    return {re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_of_a_page_leads_somewhere(page: Path) -> None:
    lost = []
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or not target.is_relative_to(ROOT) or (anchor and anchor not in anchors(target)):
            lost.append(link)
    assert lost == []


def test_every_picture_is_on_a_page() -> None:
    shown = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    pictures = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs/pictures").rglob("*.*")}
    assert {picture for picture in pictures if picture not in shown} == set()


@pytest.mark.parametrize("name", ["ap_per_corruption", "mce_map"])
def test_the_pictures_of_the_demo_are_of_its_drive_and_of_the_shipped_detectors(name: str) -> None:
    with Image.open(ROOT / f"docs/pictures/{name}.png") as picture:
        settings = json.loads(picture.text["Description"])["settings"]
    assert list(settings["datasets"]["test"]) == [f"{SCENARIO}_{TEST_SEED}"]
    for detector in (one for files in settings["methods"].values() for one in files):
        shipped = ROOT / "dsrc/checkpoints" / detector["file"]
        assert hashlib.sha256(shipped.read_bytes()).hexdigest() == detector["sha256"], "copy the new demo's pictures"


def test_the_order_of_the_tutorials_has_them_all() -> None:
    assert sorted(TUTORIALS) == sorted(set((ROOT / "docs/tutorials").glob("*.md")) - {ROOT / "docs/tutorials/index.md"})


@pytest.mark.parametrize("page", [*TUTORIALS, ROOT / "docs/closed_loop.md"], ids=lambda page: page.stem)
def test_every_command_of_a_page_parses(page: Path) -> None:
    commands = list(commands_of(page))
    assert commands
    for name, *words in commands:
        found = COMMANDS[name]
        if not isinstance(found, str):
            found = found[words.pop(0)]
        parse(command_class(found), "dsrc", words)


def test_the_page_of_models_has_every_method_with_the_bytes_that_it_sends() -> None:
    page = (ROOT / "docs/models.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`[^|]*) \|[^|]*\| ([\d,–]+) \| ([\d,–]+) \|$", page, re.MULTILINE)
    found = {name: sizes for names, *sizes in rows for name in re.findall(r"`([\w-]+)`", names)}
    assert set(found) == set(METHODS)
    for name, sizes in found.items():
        for recipe, size in zip((opv2v(), small()), sizes, strict=True):
            model = of_method(recipe, name).model
            fusion = FUSIONS[model.fusion]
            sent = message_bytes(model, fusion.values_sent(model), fusion.channels_sent(model))
            assert size == ("–" if name in ("early", "late") else f"{sent:,}"), (name, recipe.name)


def campaigns() -> dict[str, CampaignResult]:
    """Committed campaigns with the results of theirs that are committed, by the name of their folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "examples"))
        from closed_loop_page import committed
    found = (committed(path) for path in sorted((ROOT / "docs/closed_loop").glob("*.toml")))
    return {folder.name: result for folder, result in found}


def test_the_zoo_has_every_kept_detector_as_its_run_folder_records_it() -> None:
    kept = ROOT / "docs/results/dsrc-sim-small/kept"
    printed = run_script(ROOT / "examples/zoo.py", str(kept))
    assert printed.returncode == 0, printed.stderr
    page = (ROOT / "docs/zoo.md").read_text()
    assert page.partition("<!-- begin zoo -->\n")[2].partition("\n<!-- end zoo -->")[0] == printed.stdout.strip()
    detectors = sorted(kept.rglob("detector.pt"))
    assert len(detectors) == printed.stdout.count("\n") - 2  # a line each below the head
    for detector in detectors:
        recorded = json.loads((detector.parent / "result.json").read_text())["detector"]
        assert hashlib.sha256(detector.read_bytes()).hexdigest() == recorded, detector
        settings = json.loads((detector.parent / "settings.json").read_text())
        assert "folders" not in settings, f"{detector.parent}: paths of the machine that trained it"


def test_what_is_said_of_pedestrians_and_two_wheelers_is_in_their_table() -> None:
    page = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    block, _, after = page.partition("<!-- begin road_users -->\n")[2].partition("\n<!-- end road_users -->")
    text = " ".join(after.partition("[Gates]")[0].split())
    cells = (line.strip("| ").split(" | ") for line in block.splitlines()[2:])
    counts = {(network, user): [int(one) for one in row[1:4]] for network, user, *row in cells}
    found, called, _ = counts["vulnerable", "pedestrian"]
    assert f"gives {called} of the {found} pedestrians that it finds their class" in text
    (bicycles, _, so), (motorcycles, _, as_well) = (counts["vulnerable", user] for user in ("bicycle", "motorcycle"))
    assert f"and {so + as_well} of {bicycles + motorcycles} two-wheelers" in text
    assert f"on nobody instead of {counts['vulnerable', 'nobody'][0]}" in text


def test_the_gain_from_the_usual_score_is_that_of_the_twins_results() -> None:
    page = (ROOT / "docs/results.md").read_text()
    block = page.partition("<!-- begin score_thresholds_twins -->\n")[2].partition("<!-- end")[0]
    shown = {row[0]: row[1].strip("*") for row in (line.strip("| ").split(" | ") for line in block.splitlines()[2:])}
    text = (ROOT / "docs/results/dsrc-sim-twins/results.csv").read_text()
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    whole = {
        "clean": ("physical", True),
        "mean of the corruptions as published": ("paper", False),
        "mean of our corruptions": ("physical", False),
    }
    for title, (family, clean) in whole.items():
        among = [row for row in rows if row["family"] == family and (row["condition"] == "clean") is clean]
        for iou in (50, 70):
            ours, plain = (
                np.mean([float(row[f"ap_opencood_bev_{iou}"]) for row in among if row["method"] == name])
                for name in ("DSRC", "AttFuse (plain student)")
            )
            value = shown[f"{title}, {iou / 100:g}"].partition(" ")[0]
            assert float(value) == pytest.approx(100.0 * (ours - plain), abs=0.051)


def test_every_interval_in_the_text_is_in_a_table_of_differences_and_those_that_hold_0_are_no_claims() -> None:
    page = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    text = " ".join(re.sub(r"<!-- begin (\S+) -->.*?<!-- end \1 -->", "", page, flags=re.DOTALL).split())

    def rounded(*numbers: float) -> tuple[str, ...]:
        return tuple(f"{number:.1f}".replace("-0.0", "0.0") for number in numbers)

    resolved: dict[tuple[str, ...], bool] = {}
    for file in (ROOT / "docs/results").glob("*/dsrc-sim/differences*.csv"):
        for row in csv.DictReader(file.read_text(encoding="utf-8").splitlines()):
            found = rounded(*(100.0 * float(row[name]) for name in ("difference", "by_drive_low", "by_drive_high")))
            resolved[found] = resolved.get(found, False) or row["resolved"] == "True"
    interval = r"([+-]?\d+\.\d) \[([+-]?\d+\.\d+), ([+-]?\d+\.\d+)\]"
    inside = page.partition("<!-- begin score_thresholds_twins -->")[2].partition("<!-- end")[0]
    for match in re.finditer(rf"(\*\*)?{interval}", inside):
        found = rounded(*map(float, match.groups()[1:]))
        resolved[found] = resolved.get(found, False) or match.group(1) is not None
    said = list(re.finditer(r"\[([+-]?\d+\.\d), ([+-]?\d+\.\d)\]", text))
    assert len(said) > 40
    for match in said:
        before = re.sub(r"\[[^\]]*\]|@0\.\d|at 0\.\d", "", text[: match.start()])
        value = re.findall(r"[+-]?\d+\.\d", before)[-1]
        numbers = rounded(float(value), *map(float, match.groups()))
        # A bare number may be the size of a loss: "lower by 1.8 [0.7, 3.0]", "V2X-ViT leads by 14.7 [7.7, 21.5]".
        turned = rounded(-float(value), -float(match.group(2)), -float(match.group(1)))
        known = [one for one in (numbers, turned) if one in resolved and (one == numbers or value[0] not in "+-")]
        assert known, f"{value} {match.group()}"
        start = max(text.rfind(end, 0, match.start()) for end in (". ", "* ", "| ", "; "))
        clause = text[start : match.start()] + re.split(r"\. |\| |; ", text[match.start() :])[0]
        assert any(resolved[one] for one in known) or "not resolved" in clause.lower(), clause


def test_the_text_counts_the_trainings_that_are_done() -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "examples"))
        from campaign import factor
        from trainings import SEEDS, campaign
    kept = ROOT / "docs/results/dsrc-sim-small/kept"
    planned = campaign(SEEDS, factor(kept))
    done = [one for one in planned if one.detector(kept).is_file()]
    text = " ".join((ROOT / "docs/results.md").read_text(encoding="utf-8").split())
    assert f"{len(done)} of {len(planned)} planned trainings are done" in text


SENDERS = (
    "F-Cooper", "AttFuse (plain student)", "V2VNet", "V2X-ViT", "CoBEVT", "Where2comm", "CoAlign", "ERMVP",
    "MRCNet-style", "DSRC",
)  # fmt: skip
"""Table 1's published methods that send features and saw no corruption."""


def ranks_of_dsrc(table: str) -> dict[str, int]:
    """Rank of DSRC among the methods that send features, by column of a Table 1."""
    text = (ROOT / f"docs/results/dsrc-sim-small/dsrc-sim/{table}.csv").read_text(encoding="utf-8")
    rows = {row["Method"]: row for row in csv.DictReader(text.splitlines())}
    ranks = {}
    for column in rows["DSRC"]:
        if column.endswith((" 0.5", " 0.7")):
            values = {name: float(rows[name][column]) for name in SENDERS}
            better = [v < values["DSRC"] if column.startswith("mCE") else v > values["DSRC"] for v in values.values()]
            ranks[column] = 1 + sum(better)
    return ranks


def test_the_ranks_of_dsrc_in_the_text_are_those_of_table_1() -> None:
    text = " ".join((ROOT / "docs/results.md").read_text(encoding="utf-8").split())
    words = ["no", "first", "second", "third", "fourth", "fifth", "sixth", "seventh"]
    counts = ["none", "one", "two", "three", "four", "five", "six"]
    ours, published = ranks_of_dsrc("table_1"), ranks_of_dsrc("table_1_paper")
    kinds = [column.removesuffix(" 0.5") for column in ours if column.endswith(" 0.5")][1:-2]
    assert len(kinds) == 6

    def first(ranks: dict[str, int], iou: str) -> str:
        return counts[sum(ranks[f"{kind} {iou}"] == 1 for kind in kinds)]

    assert (
        f"DSRC is first at 0.5 under {first(ours, '0.5')} of our six corruptions and {first(published, '0.5')} of the "
        f"published ones, at 0.7 under {first(ours, '0.7')} and {first(published, '0.7')}, never in snow." in text
    )
    assert all(ranks[f"Snow {iou}"] > 1 for ranks in (ours, published) for iou in ("0.5", "0.7"))
    losses = [ranks[f"mCE {iou}"] for ranks in (ours, published) for iou in ("0.5", "0.7")]
    assert len(set(losses[1:])) == 1
    assert f"By mCE it is {words[losses[0]]} at 0.5 in ours and {words[losses[1]]} otherwise." in text
    inside = [ranks_of_dsrc(f"table_1_opencood{family}")["mAP 0.5"] for family in ("", "_paper")]
    assert len(set(inside)) == 1
    assert f"Sorted inside frames, from 0.2, it is {words[inside[0]]} by mAP at 0.5 in both families." in text


def test_the_gain_in_the_readme_is_that_of_the_twins() -> None:
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    with (ROOT / "docs/results/dsrc-sim-twins/dsrc-sim/differences_paper.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["condition"] == "mean_corrupted"]
    gains = " / ".join(f"{100 * float(row['difference']):.1f}" for row in rows)
    bounds = [[f"{100 * float(row[f'by_drive_{end}']):.1f}" for end in ("low", "high")] for row in rows]
    assert f"ahead of its plain student by {gains} points in the mean of the six corruptions as published" in text
    assert f"(95 % by drive: {' and '.join(' to '.join(pair) for pair in bounds)};" in text
    assert all(row["resolved"] == "True" for row in rows)


def test_the_tables_of_the_closed_loop_are_those_of_its_campaigns() -> None:
    page = (ROOT / "docs/closed_loop.md").read_text(encoding="utf-8")
    blocks = {
        f"{folder}/{section.name}": section.markdown(Path("closed_loop") / folder)
        for folder, result in campaigns().items()
        for section in sections(result)
    }
    places = re.findall(r"<!-- begin (\S+/\S+) -->\n(.*?)\n<!-- end \1 -->", page, re.DOTALL)
    published = {
        "which-corruption-kills",
        "taught-with-corruption",
        "range-around-the-ego",
        "nothing-is-hidden",
        "background-traffic",
        "pedestrians-and-bicycles",
    }
    assert {name.partition("/")[0] for name, _ in places} == published
    assert all(shown == blocks[name] for name, shown in places)
    for folder in published:
        result = campaigns()[folder]
        assert (ROOT / "docs/closed_loop" / folder / "report.md").read_text(encoding="utf-8") == markdown(result)
        planned = {(job.scenario, job.seed, job.perception, job.condition["kind"]) for job in episodes_of(result.plan)}
        assert {(one.scenario, one.seed, one.perception, one.corruption) for one in result.results} == planned


def test_what_is_said_of_training_with_corruption_is_in_its_results() -> None:
    page = (ROOT / "docs/closed_loop.md").read_text(encoding="utf-8")
    text = " ".join(page.partition("### Taught with corruption")[2].partition("<!-- begin")[0].split())
    common = parts_of(campaigns()["taught-with-corruption"])[0]

    def of(name: str, corruption: str) -> list[EpisodeResult]:
        return [one for one in common if (one.perception, one.corruption) == (name, corruption)]

    def told(value: Value, name: str, corruption: str) -> tuple[int, int]:
        met = [value(one) for one in of(name, corruption) if one.outcome != Outcome.DESYNCHRONISED.value]
        return round(sum(met)), len(met)

    new, old = "DSRC, corrupted clouds", "DSRC"
    (crashed, met), (before, _) = (told(collided, name, "snow") for name in (new, old))
    assert f"crashes in {crashed} of {met} encounters where DSRC does in {before};" in text
    assert told(collided, new, "clean") == told(collided, old, "clean") == (1, 43) and "both crash in 1 of 43." in text
    where = Counter(one.scenario for one in of(new, "snow") if collided(one))
    assert where == {"eebl_chain": 5, "stalled_after_curve": 5, "roundabout_entry": 3} and "Ten of the 13 are" in text
    (more, ours), (fewer, theirs) = (told(arrived, name, "fog") for name in (new, old))
    assert f"{more} of {ours} arrive instead of {fewer} of {theirs}" in text
    for corruption, words in (("snow", (1, 5)), ("fog", (5, 1))):
        matched = pairs(of(new, corruption), of(old, corruption))
        found = paired_rates(*([arrived(pair[side]) for pair in matched] for side in (0, 1)))
        assert (found.only_first, found.only_second) == words and found.p_value > 0.05


def test_what_is_said_of_pedestrians_and_bicycles_is_in_their_results() -> None:
    page = (ROOT / "docs/closed_loop.md").read_text(encoding="utf-8")
    text = " ".join(page.partition("### Pedestrians and bicycles")[2].partition("### Whose crash")[0].split())
    result = campaigns()["pedestrians-and-bicycles"]
    kinds = {one.corruption for one in result.results} - {"clean"}
    names = ("DSRC", "plain student", "ego alone", "late fusion")

    def of(name: str, *corruptions: str) -> list[EpisodeResult]:
        chosen = corruptions or ("clean",)
        return [one for one in result.results if one.perception == name and one.corruption in chosen]

    def compared(ours: list[EpisodeResult], theirs: list[EpisodeResult], value: Value) -> tuple[int, int, float]:
        matched = pairs(ours, theirs)
        clusters = [(one.scenario, one.seed) for one, _ in matched]
        found = paired_rates(*([value(pair[side]) for pair in matched] for side in (0, 1)), clusters=clusters)
        return round(found.only_first), round(found.only_second), found.p_value

    def of_clean(name: str, corruption: str, value: Value) -> tuple[int, int, float]:
        as_clean = [msgspec.structs.replace(one, corruption="clean", severity=0) for one in of(name, corruption)]
        return compared(as_clean, of(name), value)

    def told(value: Value, name: str, *corruptions: str) -> str:
        met = counted(of(name, *corruptions))
        return f"{round(sum(map(value, met)))} of {len(met)}"

    crashed = [round(sum(map(collided, of(name)))) for name in names]
    assert crashed[0] == crashed[1] and crashed[3] == 0
    assert f"crash in {crashed[0]} of 60 episodes each, the ego alone in {crashed[2]};" in text
    first, second, p_value = compared(of("DSRC"), of("ego alone"), arrived)
    assert f"{first} arrive with DSRC only and none with the ego only (p < 0.001)" in text
    assert second == 0 and p_value < 0.001
    alone = told(collided, "ego alone", *kinds)
    assert f"DSRC crashes in {told(collided, 'DSRC', *kinds)}, the ego alone in {alone}; " in text
    first, second, p_value = compared(of("DSRC", *kinds), of("ego alone", *kinds), arrived)
    snow = compared(of("DSRC", "snow"), of("ego alone", "snow"), arrived)
    assert f"{first} pairs arrive with DSRC only, {second} with the ego only (p < 0.001), {snow[1]} of them" in text
    assert p_value < 0.001 and snow[2] > 0.05

    assert f"DSRC arrives in {told(arrived, 'DSRC', 'snow')} episodes, all of which it finishes clean" in text
    assert f"(p = {of_clean('DSRC', 'snow', arrived)[2]:.3f})" in text
    assert f"plain student in {told(arrived, 'plain student', 'snow')} (p < 0.001)" in text
    assert of_clean("plain student", "snow", arrived)[2] < 0.001
    assert told(collided, "DSRC", "snow") == told(collided, "plain student", "snow") == "4 of 30"
    harm = [of_clean(name, "snow", collided)[2] for name in names[:2]]
    assert harm == [0.125, 0.125] and "Both crash in 4 of 30, which is not resolved against none" in text

    ours = told(arrived, "DSRC", "crosstalk").replace(" of ", " of the ")
    assert f"DSRC arrives in {ours} episodes that met" in text
    assert f"(p = {of_clean('DSRC', 'crosstalk', arrived)[2]:.3f} against" in text
    plain, late, ego = (told(arrived, name, "crosstalk") for name in ("plain student", "late fusion", "ego alone"))
    assert f"the plain student in {plain} and late fusion in {late} (p < 0.001 each), the ego alone in {ego}." in text
    assert all(of_clean(name, "crosstalk", arrived)[2] < 0.001 for name in ("plain student", "late fusion"))
    lost = Counter(one.outcome for one in of("DSRC", "crosstalk"))["desynchronised"]
    assert f"{lost} of DSRC's 30 so long" in text

    mild = ("fog", "beam_missing", "motion_blur", "cross_sensor")
    met = counted(of("DSRC", *mild))
    assert not any(map(collided, met)) and [one.corruption for one in met if not arrived(one)] == ["fog"]
    assert f"arrives in fog in {told(arrived, 'ego alone', 'fog')}." in text
    both = of("DSRC", *kinds), of("plain student", *kinds)
    first, second, p_value = compared(*both, arrived)
    assert f"in {first} pairs against {second} of {len(pairs(*both))} (p = {p_value:.3f})" in text
    assert min(compared(of("DSRC", k), of("plain student", k), arrived)[2] for k in kinds) > 0.05
    stuck = [one for one in of("late fusion") if one.scenario == "cyclist_right_hook"]
    assert f"{Counter(one.outcome for one in stuck)['stuck']} of 20 are stuck" in text
    assert told(collided, "late fusion", *kinds).startswith("0 ")
    assert f"arrives in {told(arrived, 'late fusion', *kinds)} corrupted episodes" in text
    assert {one.outcome for one in result.controls} == {"arrived"} and f"All {len(result.controls)} controls" in text


def test_what_the_closed_loop_s_page_says_is_in_its_results() -> None:
    text = " ".join((ROOT / "docs/closed_loop.md").read_text(encoding="utf-8").split())
    result = campaigns()["which-corruption-kills"]
    common = parts_of(result)[0]
    kinds = {one.corruption for one in common} - {"clean"}

    def of(name: str, *corruptions: str) -> list[EpisodeResult]:
        return [one for one in common if one.perception == name and one.corruption in corruptions]

    def compared(ours: list[EpisodeResult], theirs: list[EpisodeResult], value: Value) -> tuple[int, int, str]:
        matched = pairs(ours, theirs)
        clusters = [(one.scenario, one.seed) for one, _ in matched]
        found = paired_rates(*([value(pair[side]) for pair in matched] for side in (0, 1)), clusters=clusters)
        p_value = f"p = {found.p_value:.3f}" if found.p_value >= 0.001 else "p < 0.001"
        return round(found.only_first), round(found.only_second), p_value

    def as_clean(results: list[EpisodeResult]) -> list[EpisodeResult]:
        return [msgspec.structs.replace(one, corruption="clean", severity=0) for one in results]

    met = [sum(collided(one) for one in of(name, "clean")) for name in ("DSRC", "ego alone", "plain student")]
    assert f"DSRC crashes in {met[0]:.0f} of 171 encounters, 4 %, and the ego alone in {met[1]:.0f}, 68 %" in text
    assert f"clean ({met[0]:.0f} and {met[2]:.0f} of 171" in text and len(of("DSRC", "clean")) == 171
    assert compared(of("DSRC", "clean"), of("ego alone", "clean"), collided)[0] == 0
    words = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine"]
    more, fewer, p_value = compared(of("DSRC", *kinds), of("ego alone", *kinds), arrived)
    lost = f"in which the ego alone does not, and the other way round in {words[fewer]} ({p_value})"
    assert f"DSRC arrives in {more} pairs {lost}" in text
    more, fewer, p_value = compared(of("DSRC", *kinds), of("plain student", *kinds), arrived)
    matched = len(pairs(of("DSRC", *kinds), of("plain student", *kinds)))
    assert f"in {more} pairs against {fewer} of {matched} ({p_value})" in text
    more, fewer, p_value = compared(of("DSRC", "fog"), of("plain student", "fog"), arrived)
    assert f"in fog in {more} against {fewer} ({p_value})" in text
    for name, claim in (("DSRC", "in one of the same clean ({})"), ("plain student", "instead of two ({})")):
        assert claim.format(compared(as_clean(of(name, "snow")), of(name, "clean"), collided)[2]) in text
        foggy = as_clean([one for one in of(name, "fog") if one.outcome != Outcome.DESYNCHRONISED.value])
        _, stopped, p_value = compared(foggy, of(name, "clean"), arrived)
        here = sum(arrived(one) for one in foggy)
        assert f"in {here:.0f} of {len(foggy)} instead of {here + stopped:.0f} ({p_value})" in text
    worse, better, p_value = compared(
        as_clean(of("plain student", "cross_sensor")), of("plain student", "clean"), collided
    )
    assert f"the plain student {words[worse]} crashes and spares {words[better]} ({p_value})" in text
    worse, better, p_value = compared(as_clean(of("DSRC", "cross_sensor")), of("DSRC", "clean"), collided)
    assert better == 0 and f"DSRC's {words[worse]} are not resolved ({p_value})" in text
    for conditions, claim in ((["clean"], "(6 and 10 of 171, {})"), (kinds, "(30 of 512 and 39 of 509, {})")):
        ours, theirs = of("DSRC", *conditions), of("plain student", *conditions)
        assert claim.format(compared(ours, theirs, collided)[2]) in text
        counts = [round(sum(map(collided, results))) for results in (ours, theirs)]
        assert counts == ([6, 10] if conditions == ["clean"] else [30, 39])
    ours, theirs, p_value = compared(of("late fusion", "snow"), of("DSRC", "snow"), collided)
    assert f"in {ours} pairs late fusion only, in {theirs} DSRC only ({p_value})" in text
    snow = Counter(one.scenario for one in of("DSRC", "snow") if collided(one))
    assert snow == {"stalled_after_curve": 10, "eebl_chain": 6, "lta_truck": 2}
    assert "Sixteen of DSRC's 18 crashes in snow are on fast roads, ten of them in `stalled_after_curve`" in text
    elsewhere = [one for one in of("DSRC", "clean", *(kinds - {"snow"})) if collided(one)]
    chain = [one for one in elsewhere if one.scenario == "eebl_chain"]
    assert f"DSRC's {len(elsewhere)} crashes without snow {len(chain)} are in `eebl_chain`" in text
    spared = avoidable(common, result.careful)
    assert len(spared) - sum(spared) == 2 and all(avoidable(of("DSRC", "clean", *kinds), result.careful))
    assert {one.outcome for one in result.controls} == {"arrived"} and f"All {len(result.controls)} controls" in text


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_tutorials_run_one_after_another_as_they_are_written(tmp_path: Path) -> None:
    for name in ("dsrc", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    own = {"PATH": path}
    for page in TUTORIALS:
        for kind, block in re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
            words = [sys.executable, "-c", block] if kind == "python" else ["bash", "-euc", block]
            done = subprocess.run(words, cwd=tmp_path, env=os.environ | own, capture_output=True, text=True)
            assert done.returncode == 0, f"{page.name}:\n{block}\n{done.stdout}\n{done.stderr}"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("furo", reason="furo is not installed: pip install -e '.[docs]'")
    words = [sys.executable, "-m", "sphinx", "--quiet", "--fail-on-warning", "--keep-going", "docs", str(tmp_path)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for page in ("index", "gallery", "api", "tutorials/drive", "results"):
        assert (tmp_path / f"{page}.html").is_file()
    assert 'id="dsrc.LidarSpec"' in (tmp_path / "api.html").read_text()
    assert "helsinki_above.png" in (tmp_path / "gallery.html").read_text()
    places = {page: set(re.findall(r'\bid="([^"]+)"', page.read_text())) for page in tmp_path.rglob("*.html")}
    lost = []
    for page in places:
        for link in re.findall(r'(?:href|src)="(?!\w+:|//|#")([^"]+)"', page.read_text()):
            name, _, anchor = unquote(link).partition("#")
            target = (page.parent / name.partition("?")[0]).resolve() if name else page
            if not target.exists() or (anchor and anchor not in places.get(target, {anchor})):
                lost.append((page.name, link))
    assert lost == []


def write_clouds(folder: Path) -> None:
    """Write scans as KITTI, nuScenes and numpy have them."""
    sweep = example_frame().agents[0].sweep
    points = np.column_stack([sweep.points, sweep.intensity]).astype(np.float32)
    (folder / "velodyne").mkdir()
    (folder / "velodyne/000007.bin").write_bytes(points.tobytes())
    (folder / "nuscenes/samples/LIDAR_TOP").mkdir(parents=True)
    (folder / "nuscenes/samples/LIDAR_TOP/1.pcd.bin").write_bytes(
        np.column_stack([points, 31 - sweep.ring]).astype(np.float32).tobytes()
    )
    np.save(folder / "scan.npy", points)


def write_boxes(folder: Path) -> None:
    """Write a drive `data` and detections in it, `boxes.json`."""
    write_frame(folder / "data" / "one", toy_frame(3))
    truth = truth_of_frame(toy_frame(3)).boxes.array
    frames = [{"drive": "one", "frame": 3, "boxes": truth.tolist(), "scores": [0.9] * len(truth)}]
    (folder / "boxes.json").write_text(json.dumps({"frames": frames}))


def write_tracks(folder: Path) -> None:
    """Write tracks of two cars, `tracks.csv`."""
    rows = [f"{t},{name},{x + 8 * t},{x},0,4.5,1.8,car" for name, x in (("7", 0), ("12", 4)) for t in (0.0, 0.13, 0.2)]
    (folder / "tracks.csv").write_text("\n".join(["time,id,x,y,yaw,length,width,class", *rows]))


def write_team(folder: Path) -> None:
    """Write a drive of several agents in `data`, and a detector, `detector.pt`."""
    write_drives(folder / "data", drives=1, frames=1)
    write_detector(folder / "detector.pt", "attfuse")


YOUR_DATA = {
    "Corrupt your clouds": write_clouds,
    "Score your boxes": write_boxes,
    "LiDAR for your tracks": write_tracks,
    "Load a checkpoint": lambda folder: torch.save(network("v2vnet", kernel=3), folder / "net_epoch30.pth"),
    "Who helped": write_team,
}
"""Sections of docs/your_data.md, and the files that they are about."""


@pytest.mark.parametrize("title", YOUR_DATA)
def test_what_the_page_of_your_data_says_runs(title: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    section = (ROOT / "docs/your_data.md").read_text(encoding="utf-8").split(f"\n## {title}\n")[1].split("\n## ")[0]
    YOUR_DATA[title](tmp_path)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", section, re.DOTALL | re.MULTILINE)
    assert blocks
    for kind, block in blocks:
        assert block.count("\n") <= 5
        if kind == "python":
            exec(block, {})
        else:
            for line in block.splitlines():
                run(shlex.split(line, comments=True)[1:])


def test_the_page_of_your_data_has_every_protocol_with_what_it_counts() -> None:
    page = (ROOT / "docs/your_data.md").read_text(encoding="utf-8")
    section = page.split("\n## Score your boxes\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `([\w-]+)` \| ([^|]*) \| ([^|]*) \|$", section, re.MULTILINE)
    assert rows == [(one.name, one.card, one.source) for one in PROTOCOLS.values()]
