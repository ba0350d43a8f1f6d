"""`dsrc.view` in a real Jupyter server: the cell runs in its kernel and the page shows inline, also through a proxy."""

import csv
import json
import os
import subprocess
import sys
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from dsrc.evaluation.evaluate import evaluate_drives
from dsrc.options.detection import Evaluation
from dsrc.review.page.output.screenshot import BrowserPage, find_chromium, open_page
from dsrc.review.page.server import free_port
from tests.dsrc.evaluation.small import write_detector, write_drives
from tests.dsrc.review.page.test_browser import PATIENCE_S, PLACE, wait_for

pytest.importorskip("jupyterlab")
pytest.importorskip("jupyter_server_proxy")
pytestmark = [
    pytest.mark.extra,
    pytest.mark.browser,
    pytest.mark.skipif(find_chromium() is None, reason="needs Chromium"),
]
ROOT = Path(__file__).parents[4]
STARTED = "window.jupyterapp?.shell.currentWidget?.sessionContext?.session?.kernel"
RUN_ALL = f"{STARTED}.info.then(()=>{{void window.jupyterapp.commands.execute('notebook:run-all-cells')}})"
"""Run the notebook once its kernel answers: before that it is asked for again, and a second one takes its place."""
NUMBERS = """[...document.querySelectorAll('td')].map(e=>e.textContent)"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of an evaluation on two drives."""
    root = tmp_path_factory.mktemp("notebook")
    write_drives(root / "test")
    checkpoint = (f"DSRC={write_detector(root / 'dsrc.pt', 'dsrc')}",)
    given = {"checkpoint": checkpoint, "data": root / "test", "out": root / "run", "corruption": ("fog",)}
    evaluate_drives(Evaluation(**given, ego_alone=False))
    return root / "run"


@contextmanager
def jupyter(folder: Path, base: str, **environment: str) -> Iterator[str]:
    """Serve a folder by a Jupyter server of its own; yields its address."""
    own = {
        f"{name}_DIR": str(folder / ".jupyter" / name) for name in ("JUPYTER_CONFIG", "JUPYTER_DATA", "JUPYTER_RUNTIME")
    }
    known = {
        **os.environ,
        **own,
        "IPYTHONDIR": str(folder / ".jupyter/ipython"),
        "PYTHONPATH": str(ROOT),
        **environment,
    }
    port = free_port()
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", f"--port={port}", "--port-retries=0",
               f"--ServerApp.base_url={base}", f"--ServerApp.root_dir={folder}", "--IdentityProvider.token=",
               "--expose-app-in-browser"]  # fmt: skip
    with (folder / "server.log").open("wb") as log:
        server = subprocess.Popen(command, env=known, stdout=log, stderr=subprocess.STDOUT)
    address = f"http://127.0.0.1:{port}{base}"
    try:
        wait_for(lambda: server.poll() is not None or answers(f"{address}api"))
        assert server.poll() is None, (folder / "server.log").read_text()
        yield address
    finally:
        server.terminate()
        server.wait(30.0)


def answers(address: str) -> bool:
    try:
        with urllib.request.urlopen(address, timeout=5) as answer:
            return answer.status == 200
    except OSError:
        return False


def write_notebook(path: Path, source: str) -> None:
    cell = {"cell_type": "code", "id": "a", "metadata": {}, "outputs": [], "execution_count": None, "source": source}
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    content = {"cells": [cell], "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    path.write_text(json.dumps(content))


def frame_in(page: BrowserPage) -> dict[str, Any] | None:
    """Frame of an address in a page, None before it is there."""
    frames = page.send("Page.getFrameTree")["frameTree"].get("childFrames", [])
    return next((one["frame"] for one in frames if one["frame"]["url"].startswith("http")), None)


def evaluate_in(page: BrowserPage, script: str) -> Any:
    """Value of a script in the frame of a page, also of one that goes elsewhere meanwhile."""
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            frame = frame_in(page)
            assert frame is not None
            world = page.send("Page.createIsolatedWorld", frameId=frame["id"])["executionContextId"]
            found = page.send("Runtime.evaluate", expression=script, contextId=world, returnByValue=True)
            return found["result"].get("value")
        except RuntimeError:
            assert time.monotonic() < end, "the frame does not stay"
            time.sleep(0.1)


@pytest.mark.parametrize(
    "hub",
    [
        pytest.param(False, marks=pytest.mark.slow, id="this machine"),
        pytest.param(True, id="through a hub's proxy of ports"),
    ],
)
def test_a_cell_shows_the_page_inline_with_the_counts_of_the_run(run: Path, tmp_path: Path, hub: bool) -> None:
    base = "/user/me/" if hub else "/"
    prefix = {"JUPYTERHUB_SERVICE_PREFIX": base} if hub else {}
    allowed = ", allow_origin=('127.0.0.1',)" if hub else ""
    write_notebook(tmp_path / "review.ipynb", f"import dsrc\ndsrc.view({str(run)!r}{allowed})")
    with (run / "causes.csv").open() as file:
        rows = csv.DictReader(line for line in file if not line.startswith("#"))
        told = Counter(row["error"] for row in rows if row["condition"] == "clean")
    with (
        jupyter(tmp_path, base, **prefix) as address,
        open_page(f"{address}lab/tree/review.ipynb", (1400, 900)) as page,
    ):
        page.send("Emulation.setFocusEmulationEnabled", enabled=True)
        page.wait_for(f"{STARTED} && document.querySelector('.jp-CodeCell')", PATIENCE_S)
        page.evaluate(RUN_ALL)
        wait_for(lambda: frame_in(page), otherwise=lambda: page.evaluate("document.body.innerText"))
        wait_for(lambda: "clean" in evaluate_in(page, NUMBERS))
        cells = evaluate_in(page, NUMBERS)
        missed, false = cells[cells.index("clean") + 3 :][:2]
        assert (int(missed), int(false)) == (told["missed"], told["false"]) != (0, 0)
        assert evaluate_in(page, "location.pathname").startswith(f"{base}proxy/") == hub
        # Cells open in the frame, not in place of the notebook.
        x, y = page.evaluate(PLACE.replace("__SCRIPT__", "document.querySelector('iframe')"))[:2]
        for kind in ("mousePressed", "mouseReleased"):
            page.send("Input.dispatchMouseEvent", type=kind, x=x, y=y - 100, button="left", clickCount=1)
        for kind in ("keyDown", "keyUp"):
            page.send("Input.dispatchKeyEvent", type=kind, key="y", code="KeyY", windowsVirtualKeyCode=89)
        wait_for(lambda: evaluate_in(page, "location.pathname").endswith("/compare"))
        assert "/lab/" in page.evaluate("location.pathname")
