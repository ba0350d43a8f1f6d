"""Drivers in processes of their own: real programs that drive, die, hang and talk nonsense."""

import sys
from pathlib import Path

import numpy as np
import pytest

from dsrc.closed_loop.driving.open import driver_sha256, open_driver
from dsrc.closed_loop.driving.own.process import ProcessDriver
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Outcome
from sim.errors import DataError, SettingsError
from tests.paths import ROOT

ROAD = "ima_building:no_conflict"
EXAMPLE = f"pipe:{sys.executable} {ROOT / 'examples' / '13_driver_process.py'}"
PROGRAM = """
import sys, time, os, json, struct
import numpy as np
def read():
    length = struct.unpack("<4sI", sys.stdin.buffer.read(8))[1]
    header, arrays = json.loads(sys.stdin.buffer.read(length)), {}
    for name, kind, shape in header["arrays"]:
        content = sys.stdin.buffer.read(int(kind[1]) * int(np.prod(shape, dtype=int)))
        arrays[name] = np.frombuffer(content, kind).reshape(shape)
    return header, arrays
def write(header, rest=b""):
    content = json.dumps(header).encode()
    sys.stdout.buffer.write(struct.pack("<4sI", b"DSRC", len(content)) + content + rest)
    sys.stdout.buffer.flush()
def decide(acceleration, **more):
    arrays = [["decision", "f8", [1]]]
    write({"type": "decision", "arrays": arrays, **more}, struct.pack("<d", acceleration))
hello = read()[0]
write({"type": "hello", "protocol": 1, "role": "driver", "name": "toy", "wants": WANTS})
steps = 0
while True:
    header, arrays = read()
    if header["type"] == "reset":
        write({"type": "ready"})
        continue
    steps += 1
"""


def program(folder: Path, code: str, wants: tuple[str, ...] = ()) -> str:
    path = folder / "drive.py"
    body = "\n".join(f"    {line}" for line in code.splitlines())
    path.write_text(PROGRAM.replace("WANTS", repr(list(wants))) + body + "\n")
    return f"pipe:{sys.executable} {path}"


def drive(text: str, limit_s: float = 20.0, perception: str = "truth", duration_s: float = 3.0) -> ClosedLoop:
    settings = LoopSettings(perception_limit_s=limit_s, duration_s=duration_s)
    driver = open_driver(text, limit_s)
    loop = ClosedLoop(ROAD, open_perception(perception), driver, settings)
    loop.run(1)
    if isinstance(driver, ProcessDriver):
        driver.close()
    return loop


def test_a_process_drives_as_the_class_of_the_same_law_bit_for_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT / "examples")
    paths = []
    for number, text in enumerate((EXAMPLE, EXAMPLE, "12_highway_env_driver:Idm")):
        loop = drive(text, duration_s=3.0)
        assert loop.message == "" and loop.tick.ego.progress_m > 15.0
        paths.append([(tick.ego.progress_m, tick.decision.acceleration_mps2) for tick in loop.ticks])
        if number < 2:
            loop.log().save(tmp_path / f"{number}.npz")
    assert paths[0] == paths[1] == paths[2]
    assert (tmp_path / "0.npz").read_bytes() == (tmp_path / "1.npz").read_bytes()


def test_a_process_is_told_its_state_its_route_the_tracks_the_lanes_and_what_is_seen(tmp_path: Path) -> None:
    code = f"""
keep = {{**arrays, "header": np.array(json.dumps(header))}}
np.savez({str(tmp_path / "told")!r} + str(steps), **keep)
decide(-1.0, reason="yield", track=int(arrays["track"][0]) if len(arrays["track"]) else -1)
"""
    loop = drive(program(tmp_path, code, ("conflicts", "seen")), duration_s=0.3)
    tick = loop.ticks[1]
    assert (tick.decision.acceleration_mps2, tick.decision.reason) == (-1.0, "yield")
    with np.load(tmp_path / "told2.npz") as told:
        assert np.array_equal(told["ego_box"], tick.ego.box.array[0])
        assert np.array_equal(told["route"], tick.ego.route)
        assert np.array_equal(told["boxes"], tick.tracks.boxes.array)
        assert np.array_equal(told["velocity"], tick.tracks.velocity)
        header = str(told["header"])
        assert f'"speed_mps": {tick.ego.speed_mps!r}' in header and '"views": [{"agent_id": ' in header
        assert '"meets": ' in header and told["conflict_0"].shape[1] == 4
        assert told["view_0"].dtype == np.uint8 and told["view_0"].all()


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (
            "if steps == 3: print('no memory', file=sys.stderr); sys.exit(3)\ndecide(0.0)",
            "its end with code 3: no memory",
        ),
        ("if steps == 3: time.sleep(600)\ndecide(0.0)", "answer: expected one within 1 s, found none"),
        ("decide(float('nan'))", "decide: expected a finite acceleration, found nan"),
        ("decide(0.0, reason='x' * 50)", r"answer to decide\.reason: expected str of length <= 40, found x{50}$"),
        ("write({'type': 'decision'})", r"decision: expected floats of shape \(1,\) or \(2,\), found none"),
        ("write({'type': 'boxes'})", "type: expected decision, found boxes"),
        ("write({'type': 'error', 'message': 'CUDA\\nout of memory'})", "the driver says: CUDA out of memory"),
        (
            "os.write(1, b'Epoch 1 of 300')",
            r"drive\.py: answer to decide: expected a message that begins with DSRC, found b'Epoch 1 '$",
        ),
        (
            "decide(1e9)",
            r"^ValueError: decide: expected an acceleration of at most 1e\+06 m/s2 either way, found 1e\+09$",
        ),
    ],
    ids=["dies", "hangs", "nan", "long reason", "no array", "detector's answer", "error", "prints", "units"],
)
def test_a_process_that_fails_ends_the_episode_with_its_reason(code: str, words: str, tmp_path: Path) -> None:
    loop = drive(program(tmp_path, code), limit_s=1.0)
    assert loop.outcome is Outcome.DRIVER_FAILED
    with pytest.raises(ValueError, match=words):
        raise ValueError(loop.message)
    assert "\n" not in loop.message and loop.log(driver="toy").outcome is Outcome.DRIVER_FAILED


def test_a_process_that_never_says_hello_is_told_of_and_then_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "asleep.py"
    path.write_text("import time\ntime.sleep(600)\n")
    monkeypatch.setattr("dsrc.closed_loop.driving.own.process.START_S", 0.4)
    monkeypatch.setattr("dsrc.detectors.line._TOLD_S", 0.2)
    with pytest.raises(DataError, match=r"asleep\.py: answer: expected one within 0\.4 s, found none$"):
        open_driver(f"pipe:{sys.executable} {path}", 0.1)
    assert "asleep.py: no answer yet, which may take up to 0.4 s" in caplog.text


def test_an_answer_that_comes_late_is_a_failure(tmp_path: Path) -> None:
    text = program(tmp_path, "if steps == 3: time.sleep(0.3)\ndecide(0.0)")
    driver = open_driver(text)  # it waits longer than the loop allows
    loop = ClosedLoop(ROAD, open_perception("truth"), driver, LoopSettings(perception_limit_s=0.25, duration_s=3.0))
    assert loop.run(1) is Outcome.DRIVER_FAILED and "limit 0.25 s" in loop.message


def test_a_process_that_failed_is_started_anew_for_the_next_episode(tmp_path: Path) -> None:
    mark = tmp_path / "second"
    code = f"""
if not os.path.exists({str(mark)!r}):
    open({str(mark)!r}, "w")
    sys.exit(1)
decide(1.0)
"""
    loop = ClosedLoop(ROAD, open_perception("truth"), open_driver(program(tmp_path, code)), LoopSettings(duration_s=1))
    assert loop.run(1) is Outcome.DRIVER_FAILED
    assert loop.run(1) is Outcome.TIMEOUT and loop.message == ""


def test_a_process_that_comes_back_under_another_name_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "drive.py"
    text = program(tmp_path, "sys.exit(1)")
    loop = ClosedLoop(ROAD, open_perception("truth"), open_driver(text), LoopSettings(duration_s=1))
    assert loop.run(1) is Outcome.DRIVER_FAILED
    path.write_text(path.read_text().replace('"name": "toy"', '"name": "another"'))
    for _ in range(2):
        assert loop.run(1) is Outcome.DRIVER_FAILED and "name: expected toy, found another" in loop.message


def test_what_is_no_driver_is_refused(tmp_path: Path) -> None:
    for text, words in {
        "plannin": "did you mean 'planning'?",
        "driver.pt": "expected planning, anticipating, evading, careful, module:Class, pipe:COMMAND or tcp://localhost:PORT",
        "json:JSONDecoder": "expected a class with reset and decide, found a JSONDecoder without them",
        "nowhere_at_all:Driver": "a class that loads, found ModuleNotFoundError",
        "pipe:": "command: expected pipe:COMMAND",
        "tcp://example.org:80": "address: expected tcp://localhost:PORT",
    }.items():
        with pytest.raises(SettingsError) as raised:
            open_driver(text)
        assert words in str(raised.value)
    with pytest.raises(DataError, match="a driver that listens"):
        open_driver("tcp://localhost:1")
    detector = f"pipe:{sys.executable} {ROOT / 'examples' / '11_detector_process.py'}"
    with pytest.raises(DataError, match=r"py: answer to hello\.role: expected a value, found nothing$"):
        open_driver(detector)


def test_the_key_of_episodes_knows_command_name_and_script(tmp_path: Path) -> None:
    first = driver_sha256(program(tmp_path, "decide(0.0)"))
    assert first == driver_sha256(program(tmp_path, "decide(0.0)"))
    assert first != driver_sha256(program(tmp_path, "decide(1.0)"))
    assert driver_sha256("planning") == ""
