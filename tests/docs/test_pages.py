"""Docs: no link leads nowhere, and the tutorials run as they are written."""

import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
import torch
from PIL import Image

from dsrc.cli.demo import SCENARIO, TEST_SEED
from dsrc.cli.main import COMMANDS, command_class, run
from dsrc.cli.options import parse
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.evaluation.metrics.protocols import PROTOCOLS
from dsrc.evaluation.scoring.truth import truth_of_frame
from dsrc.models.compression import message_bytes
from dsrc.models.fusion import FUSIONS
from dsrc.training.recipes import METHODS, of_method, opv2v, small
from sensors.corruptions.check import example_frame
from tests.dsrc.data.toy import toy_frame
from tests.dsrc.evaluation.small import write_detector, write_drives
from tests.dsrc.models.storage.opencood_networks import network
from tests.paths import ROOT
from tests.test_readme import commands_of

PAGES = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "examples/*.md", "studies/**/*.md", "benchmarks/*.md", "scenarios/**/*.md")
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


@pytest.mark.parametrize(
    "page",
    [*TUTORIALS, *(ROOT / f"docs/{name}.md" for name in ("closed_loop", "faults", "attacks", "campaigns"))],
    ids=lambda page: page.stem,
)
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
    (folder / "painted").mkdir()
    scores = np.full((len(points), 4), 0.25, np.float32)
    (folder / "painted/000007.bin").write_bytes(np.hstack([points, scores]).tobytes())
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
