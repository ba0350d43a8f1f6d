"""Detectors in processes of their own: real programs that answer, die, hang and talk nonsense."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.sample import Sample, make_sample
from dsrc.detectors.open import detector_sha256
from dsrc.detectors.process import ProcessDetector
from sim.errors import DataError, SettingsError
from tests.dsrc.data.toy import toy_frame
from tests.paths import ROOT

EXAMPLE = ROOT / "examples" / "11_detector_process.py"
PIPE = f"pipe:{sys.executable} {EXAMPLE}"
HELLO = """
import sys, time, os, json, struct
def read():
    length = struct.unpack("<4sI", sys.stdin.buffer.read(8))[1]
    header = json.loads(sys.stdin.buffer.read(length))
    for name, kind, shape in header["arrays"]:
        sys.stdin.buffer.read(int(kind[1]) * eval("*".join(map(str, shape))))
    return header
def write(header, rest=b""):
    content = json.dumps(header).encode()
    sys.stdout.buffer.write(struct.pack("<4sI", b"DSRC", len(content)) + content + rest)
    sys.stdout.buffer.flush()
read()
write({"type": "hello", "protocol": 1, "name": "toy", "range_m": [-51.2, -25.6, -3, 51.2, 25.6, 1]})
read()
"""


def sample() -> Sample:
    return make_sample(toy_frame(0), None, ProcessDetector(PIPE).settings)


@pytest.fixture(scope="module")
def example() -> Iterator[ProcessDetector]:
    detector = ProcessDetector(PIPE)
    yield detector
    detector.close()


def program(folder: Path, code: str, hello: str = HELLO) -> str:
    path = folder / "serve.py"
    path.write_text(hello + code)
    return f"pipe:{sys.executable} {path}"


def test_a_process_says_what_it_is_and_detects(example: ProcessDetector) -> None:
    assert example.name == "densest cells, version 1"
    assert example.settings.grid.range_m == (-51.2, -25.6, -3.0, 51.2, 25.6, 1.0)
    one, again = example.detect(sample()), example.detect(sample())
    assert len(one) > 0 and np.all(np.diff(one.score) <= 0)
    assert np.array_equal(one.boxes.array, again.boxes.array)
    assert np.allclose(one.boxes.size, [4.5, 1.9, 1.6])


def test_a_port_of_this_machine_serves_several(example: ProcessDetector) -> None:
    port = 20000 + os.getpid() % 20000
    server = subprocess.Popen([sys.executable, str(EXAMPLE), "--port", str(port)])
    try:
        opened: list[ProcessDetector] = []
        deadline = time.monotonic() + 60.0
        while len(opened) < 2:
            try:
                opened.append(ProcessDetector(f"tcp://localhost:{port}"))
            except DataError:
                assert time.monotonic() < deadline
                time.sleep(0.1)
        found = [one.detect(sample()).boxes.array for one in opened]
        assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], example.detect(sample()).boxes.array)
        for one in opened:
            one.close()
    finally:
        server.kill()
        server.wait()


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("print('no memory', file=sys.stderr); sys.exit(3)", "its end with code 3: no memory"),
        (
            "os.write(1, b'Epoch 1 of 300'); time.sleep(60)",
            r"begins with DSRC, found b'Epoch 1 '",
        ),
        ("write({'type': 'hello'})", "type: expected boxes, found hello"),
        ("write({'type': 'error', 'message': 'CUDA\\nout of memory'})", "the detector says: CUDA out of memory"),
        ("write({'type': 'boxes'})", r"boxes: expected floats of shape \(N, 7\), found none"),
        (
            "write({'type': 'boxes', 'arrays': [['boxes', 'f8', [1, 7]], ['score', 'f8', [2]]]}, bytes(72))",
            "expected as many scores.*found 1 boxes, 2 scores",
        ),
        (
            "write({'type': 'boxes', 'arrays': [['boxes', 'f8', [1, 7]], ['score', 'f8', [1]]]}, bytes(64))",
            "lengths, widths and heights above 0, found 0 m",
        ),
        (
            "write({'type': 'boxes', 'arrays': [['boxes', 'f8', [1, 7]], ['score', 'f8', [1]]]},"
            " struct.pack('<8d', *[1.0] * 7, 40.0))",
            "score: expected 0 to 1, found 40",
        ),
        (
            "write({'type': 'boxes', 'arrays': [['boxes', 'f8', [9, 7]]]}, bytes(8)); sys.exit(0)",
            "504 bytes, found 8,",
        ),
    ],
)
def test_a_process_that_fails_is_told_in_one_line(code: str, words: str, tmp_path: Path) -> None:
    detector = ProcessDetector(program(tmp_path, code))
    with pytest.raises(DataError, match=words) as raised:
        detector.detect(sample())
    assert "\n" not in str(raised.value) and "serve.py" in str(raised.value)


def test_a_process_that_hangs_is_ended(tmp_path: Path) -> None:
    text = program(tmp_path, f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(600)")
    detector = ProcessDetector(text)
    detector.answer_s = 2.0
    with pytest.raises(DataError, match="answer: expected one within 2 s, found none"):
        detector.detect(sample())
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), signal.SIGCONT)


def test_a_process_that_failed_is_started_anew_for_the_next_sample(tmp_path: Path) -> None:
    mark = tmp_path / "second"
    code = f"""
if not os.path.exists({str(mark)!r}):
    open({str(mark)!r}, "w")
    sys.exit(1)
write({{"type": "boxes", "arrays": [["boxes", "f4", [0, 7]], ["score", "f4", [0]]]}})
"""
    detector = ProcessDetector(program(tmp_path, code))
    with pytest.raises(DataError, match="its end with code 1"):
        detector.detect(sample())
    assert len(detector.detect(sample())) == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("pipe:", "command: expected pipe:COMMAND"),
        ("pipe:python 'open", "command: expected pipe:COMMAND"),
        ("tcp://example.org:80", "address: expected tcp://localhost:PORT, on this machine alone"),
        ("tcp://localhost", "address: expected tcp://localhost:PORT"),
        ("tcp://localhost:99999", "address: expected tcp://localhost:PORT"),
    ],
)
def test_what_names_no_process_is_refused(text: str, words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        ProcessDetector(text)


def test_a_command_that_does_not_start_or_answer_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="a program that starts, found No such file"):
        ProcessDetector("pipe:/nowhere/python serve.py")
    with pytest.raises(DataError, match="its end with code 1: ModuleNotFoundError: No module named 'pcdet_of_mine'"):
        ProcessDetector(program(tmp_path, "", "import pcdet_of_mine\n"))
    with pytest.raises(DataError, match="address: expected a detector that listens, found"):
        ProcessDetector("tcp://127.0.0.1:1")


def test_the_key_of_results_knows_command_name_and_script(tmp_path: Path) -> None:
    text = program(tmp_path, "")
    first = detector_sha256(text)
    assert first == detector_sha256(text)
    program(tmp_path, "# other weights\n")
    other = detector_sha256(text)
    program(tmp_path, "", HELLO.replace('"toy"', '"toy 2"'))
    assert len({first, other, detector_sha256(text)}) == 3
