"""Fuzzing of every reader of untrusted files: mutated real files, in forked processes with bounded memory and time.

    python -m tests.fuzz.run --inputs 3000 --seed 1

The last line is `N inputs, 0 stack traces, 0 hangs`. Whoever wants to see an input again gives its seed and number.
"""

import argparse
import gc
import os
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
import warnings
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sim.errors import UserError
from tests.fuzz.mutations import mutated
from tests.fuzz.targets import Target, targets

MEMORY_BYTES = 2 << 30
"""Memory that a reader may take beyond what the process has."""
TIME_S = 10.0
"""Time that a reader may take, s."""
LONGEST_LINE = 3000

_SPECIALS = ("pipe", "device", "folder", "nothing", "empty")


@dataclass
class Outcome:
    """Counts of a run, and a description of each fault."""

    inputs: int = 0
    traces: list[str] = field(default_factory=list)
    hangs: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return f"{self.inputs} inputs, {len(self.traces)} stack traces, {len(self.hangs)} hangs"


def fuzz(folder: Path, inputs: int, seed: int, only: str = "") -> Outcome:
    """Feed what is no file to all readers once, of another kind by another seed, then mutated files in turn.

    Args:
        folder: empty folder for the files.
        inputs: mutated files.
        seed: of the mutations.
        only: part of the names of the readers; empty for all.
    """
    readers = [one for one in targets(folder) if only in one.name]
    outcome = Outcome()
    for reader in readers:
        with suppress(UserError):  # loads what it needs, once for all processes
            reader.read(reader.path)
    gc.freeze()  # children share the pages
    for row, reader in enumerate(readers):
        if reader.is_file:
            _feed_special(reader, _SPECIALS[(seed + row) % len(_SPECIALS)], outcome)
    for number in range(inputs):
        reader = readers[number % len(readers)]
        original = reader.path.read_bytes()
        try:
            reader.path.write_bytes(mutated(reader.path, reader.kind, np.random.default_rng([seed, number])))
            _note(outcome, f"{reader.name}, seed {seed}, number {number}", *_run(reader))
        finally:
            reader.path.write_bytes(original)
    return outcome


def _feed_special(reader: Target, special: str, outcome: Outcome) -> None:
    """Put what is no regular file in the place of a file."""
    kept = reader.path.with_name(".kept")
    reader.path.rename(kept)
    try:
        match special:
            case "pipe":
                os.mkfifo(reader.path)
            case "device":
                reader.path.symlink_to("/dev/zero")
            case "folder":
                reader.path.mkdir()
            case "empty":
                reader.path.touch()
        _note(outcome, f"{reader.name}, {special} for a file", *_run(reader))
    finally:
        if reader.path.is_dir():
            reader.path.rmdir()
        reader.path.unlink(missing_ok=True)
        kept.rename(reader.path)


def _note(outcome: Outcome, name: str, code: int, said: str) -> None:
    outcome.inputs += 1
    if code == -signal.SIGKILL:
        outcome.hangs.append(name)
    elif code != 0:
        outcome.traces.append(f"{name}: exit code {code}\n{said}")


def _run(reader: Target) -> tuple[int, str]:
    """Read in a process of its own; return its exit code, and the stack trace or the message that is not one line."""
    receiving, sending = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(receiving)
        os._exit(_read(reader, sending))
    os.close(sending)
    said = b""
    end = time.monotonic() + TIME_S
    while (left := end - time.monotonic()) > 0 and select.select([receiving], [], [], left)[0]:
        part = os.read(receiving, 65536)
        if not part:
            break
        said += part
    else:
        os.kill(child, signal.SIGKILL)
    os.close(receiving)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status), said.decode("utf-8", "replace")


def _read(reader: Target, sending: int) -> int:
    warnings.simplefilter("ignore")  # a processor's warning of a broken number is no stack trace to a user
    devnull = os.open(os.devnull, os.O_WRONLY)
    for number in (1, 2):
        os.dup2(devnull, number)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, used + MEMORY_BYTES))
    try:
        reader.read(reader.path)
    except UserError as error:
        line = str(error)
        if "\n" in line or len(line) > LONGEST_LINE:
            os.write(sending, f"not a line: {line[:500]!r}".encode("utf-8", "replace"))
            return 3
    except BaseException:
        os.write(sending, traceback.format_exc()[-6000:].encode("utf-8", "replace"))
        return 3
    return 0


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--inputs", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--only", default="", help="part of the names of the readers")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        outcome = fuzz(Path(folder), options.inputs, options.seed, options.only)
    for name in outcome.hangs:
        print(f"hang: {name}")
    for text in outcome.traces:
        print(text)
    print(outcome)
    sys.exit(bool(outcome.traces or outcome.hangs))


if __name__ == "__main__":
    main()
