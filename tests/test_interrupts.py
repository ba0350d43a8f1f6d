"""Interrupts, full disks and closed pipes: an exit code and at most one line, at any moment of a command."""

import importlib
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dsrc.cli.interrupts import Interrupts
from dsrc.data.write import write_drive
from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import save_detector
from dsrc.training.recipes import debug
from tests.commands import dsrc
from tests.dsrc.data.toy import SETTINGS, ToySource

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a drive and a detector."""
    folder = tmp_path_factory.mktemp("place")
    write_drive(folder / "data" / "toy_3", {**SETTINGS, "frames": 60}, ToySource().open)
    save_detector(folder / "detector.pt", Detector(debug().model))
    return folder


VERBS = {
    "corrupt": ("corrupt", "data", "--corruption", "fog", "--out", "foggy{n}"),
    "workers": ("corrupt", "data", "--corruption", "snow", "--workers", "2", "--out", "snowy{n}"),
    "generate": ("generate", "four_way", "--frames", "50", "--out", "new{n}"),
    "evaluate": ("evaluate", "data", "--checkpoint", "detector.pt", "--out", "results{n}"),
    "train": ("model", "train", "debug", "--data", "data", "--out", "run{n}", "--epochs", "500"),
    "view": ("view", "data", "--out", "page{n}.html"),
}
QUICK = {("workers", 0.0), ("workers", 0.6), ("generate", 0.6), ("evaluate", 0.6)}
"""Verbs and delays of the quick tests."""
ANEW = {"view"}
"""Verbs that keep nothing of what they have done."""


def wait_for_handlers(process: subprocess.Popen) -> None:
    """Wait until the command takes SIGTERM, which Python does not by itself."""
    status = Path(f"/proc/{process.pid}/status")
    while process.poll() is None:
        caught = int(re.search(r"SigCgt:\s*(\w+)", status.read_text())[1], 16)
        if caught >> (signal.SIGTERM - 1) & 1:
            return
        time.sleep(0.005)


@pytest.mark.parametrize(
    ("verb", "delay_s"),
    [
        pytest.param(verb, delay_s, marks=() if (verb, delay_s) in QUICK else pytest.mark.slow)
        for verb in VERBS
        for delay_s in (0.0, 0.6, 2.5)
    ],
)
def test_an_interrupt_ends_a_command_with_one_line(verb: str, delay_s: float, place: Path) -> None:
    number = signal.SIGTERM if delay_s == 0.6 else signal.SIGINT
    words = [word.format(n=f"{delay_s:g}") for word in VERBS[verb]]
    process = subprocess.Popen(
        [sys.executable, "-m", "dsrc", *words],
        cwd=place,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    wait_for_handlers(process)
    time.sleep(delay_s)
    if process.poll() is None:
        os.killpg(process.pid, number)  # as a terminal does: to the workers too
    _, said = process.communicate(timeout=60)
    if process.returncode == 0:  # had ended before
        assert "Traceback" not in said
        return
    assert process.returncode == CODES[number], said
    assert "Traceback" not in said and said.count("dsrc: ") == 1, said
    word = "terminated" if number == signal.SIGTERM else "interrupted"
    again = "starts anew" if verb in ANEW else "resumes"
    assert said.splitlines()[-1] == f"dsrc: {word}; the same command again {again}", said


def test_a_terminated_page_ends_though_a_browser_holds_a_connection_that_asks_nothing(place: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "dsrc", "view", "data"],
        cwd=place,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert process.stdout is not None
    host, port = re.search(r"http://([\d.]+):(\d+)", process.stdout.readline()).groups()
    with socket.create_connection((host, int(port))):
        time.sleep(0.5)
        process.terminate()
        _, said = process.communicate(timeout=60)
    assert process.returncode == 0 and "Traceback" not in said, said


def test_an_interrupt_waits_for_an_import_that_would_swallow_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As packages of the wild do: whatever goes wrong means that an optional part is missing.
    (tmp_path / "greedy_import.py").write_text(
        "import os, signal, time\n"
        "try:\n    os.kill(os.getpid(), signal.SIGINT)\n    time.sleep(0.1)\n"
        "except BaseException:\n    swallowed = True\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with Interrupts() as interrupts:
        try:
            module = importlib.import_module("greedy_import")
            assert not hasattr(module, "swallowed") and interrupts.received == signal.SIGINT
            time.sleep(5.0)
        except KeyboardInterrupt:
            return
    raise AssertionError("lost")


def test_the_handlers_of_the_caller_are_put_back() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)]
    with Interrupts():
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)] == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_standard_output_is_one_line() -> None:
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [sys.executable, "-m", "dsrc", "scenario", "list"], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert (result.returncode, result.stderr) == (2, "dsrc: standard output: No space left on device\n")


def test_a_closed_standard_error_is_no_stack_trace() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as closed:
        result = subprocess.run(
            [sys.executable, "-m", "dsrc", "scenario", "show", "none"], stdout=subprocess.PIPE, stderr=closed, text=True
        )
    assert (result.returncode, result.stdout) == (141, "")


@pytest.mark.parametrize(
    "words",
    [
        ("corrupt", "{data}", "--corruption", "beam_missing", "--out", "{out}"),
        ("dataset", "convert", "{data}", "--to", "mcap", "--out", "{out}"),
        ("model", "import", "{detector}", "--out", "{out}/x.pt"),
        ("view", "{data}", "--out", "{out}/page.html", "--frames", "1"),
        pytest.param(
            ("model", "train", "debug", "--data", "{data}", "--out", "{out}", "--epochs", "1"), marks=pytest.mark.slow
        ),
        ("dataset", "card", "{data}", "--out", "{out}"),
    ],
)
def test_a_full_disk_is_one_line_with_the_name_of_a_file(
    words: tuple[str, ...], place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A limit on the size of files stands for a disk that is full: writing fails after some bytes.
    out = tmp_path / "out"
    values = {"data": place / "data", "detector": place / "detector.pt", "out": out}
    arguments = [word.format(**values) for word in words]
    if words[1] in ("train", "convert"):  # their packages' writers end with the process
        code = (
            "import resource, sys; sys.dont_write_bytecode = True;"
            "resource.setrlimit(resource.RLIMIT_FSIZE, (1500, 1500));"
            "from dsrc.__main__ import main; main(sys.argv[1:])"
        )
        result = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    else:
        monkeypatch.setattr(sys, "dont_write_bytecode", True)  # a module cut short would be imported ever after
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1500, before[1]))
        try:
            result = dsrc(*arguments)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    said = [line for line in result.stderr.splitlines() if "Traceback" in line or line.startswith("dsrc: ")]
    assert result.returncode == 2 and len(said) == 1, result.stderr[-2000:]
    assert str(out) in said[0] or words[1] == "import", said


def test_impossible_names_are_one_line(place: Path, tmp_path: Path) -> None:
    long = "n" * 300
    for words in (
        ("view", place / "data", "--out", tmp_path / f"{long}.html"),
        ("corrupt", place / "data", "--corruption", "fog", "--out", tmp_path / long),
        ("generate", long, "--out", tmp_path / "out"),
        ("view", tmp_path / long, "--out", tmp_path / "page.html"),
        ("evaluate", place / "data", "--checkpoint", long, "--out", tmp_path / "out"),
        ("scenario", "show", long + ".toml"),
    ):
        result = dsrc(*map(str, words))
        assert result.returncode == 2 and result.stderr.count("\n") == 1, (words, result.stderr)


def test_interrupts_after_the_end_change_nothing() -> None:
    """Python resets its handlers before it is gone; signals that come then would kill a command that has succeeded."""
    script = (
        "import atexit, os, signal\n"
        "atexit.register(lambda: [os.kill(os.getpid(), signal.SIGINT) for _ in range(3)])\n"  # runs last of all
        "import sys\n"
        "sys.argv = ['dsrc', '--version']\n"
        "from dsrc.__main__ import main\n"
        "main()\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert (ended.returncode, ended.stderr) == (0, "")
