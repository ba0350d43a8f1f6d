"""Detector in a process of its own: a program that answers over its standard input and output, or on a local port.

So detectors of OpenPCDet, mmdetection3d or OpenCOOD run in their own environment. `examples/11_detector_process.py` is
the other end, to be copied into it; `message.py` says what is sent.
"""

import os
import select
import signal
import socket
import subprocess
import tempfile
import threading
import time
import weakref
from collections.abc import Mapping
from typing import IO, Any, Protocol
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import Sample, SampleRequest
from dsrc.detectors.answers import of_arrays
from dsrc.detectors.message import PROTOCOL, Failure, Found, Header, Hello, Message, decode, encode
from dsrc.detectors.texts import command_of
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sim.boxes import VEHICLES, VULNERABLE
from sim.errors import DataError, SettingsError, complaint, one_line

ANSWER_S = 300.0
"""Longest time to an answer, s: a large network on a busy CPU; the first also loads the weights."""
_END_S = 2.0
_LOCAL = ("localhost", "127.0.0.1", "::1")


class _Line(Protocol):
    """Two-way line of bytes to a process."""

    reads: int
    writes: int

    def ended(self) -> str:
        """Return what is known of the end of the process."""
        ...

    def close(self) -> None:
        """Close the line, and end a process that was started for it."""
        ...


class ProcessDetector:
    """Detector that a process is; see `dsrc.data.sample.SampleDetector`. Each process of ours opens its own.

    Args:
        text: `pipe:COMMAND ...`, without a shell, or `tcp://localhost:PORT`.
        answer_s: longest time to an answer, s.

    Attributes:
        name: as the process says.
        settings: as the process says.
        classes: of what it detects.

    Raises:
        SettingsError: the text names no command or no local port.
        DataError: the process does not start, ends, hangs or answers something else.
    """

    def __init__(self, text: str, answer_s: float = ANSWER_S) -> None:
        self.text, self.answer_s = text, answer_s
        self._lock = threading.Lock()
        self._open()

    def _open(self) -> None:
        self._line: _Line = _Port(self.text) if self.text.startswith("tcp:") else _Program(self.text)
        self._process_id = os.getpid()
        self._end = weakref.finalize(self, self._line.close)
        hello = self._ask({"type": "hello", "protocol": PROTOCOL}, {}, Hello)[0]
        try:
            grid = GridSpec(hello.range_m)
        except ValueError as error:
            self._end()
            raise self._wrong("hello: range_m", "minima below maxima", str(error)) from None
        self.name = hello.name
        self.settings = SampleRequest(grid, hello.comm_range_m, hello.max_agents, hello.users)
        self.classes = VEHICLES if hello.users == "vehicles" else VULNERABLE

    def detect(self, sample: Sample) -> Detections:
        """Detect in one sample, best first, in its frame.

        Raises:
            DataError: the process ends, hangs or answers something else; the next sample starts it anew.
        """
        with self._lock:
            if self._process_id != os.getpid() or not self._end.alive:
                self._open()  # a line that a fork has copied is another's
            question = {"type": "detect", "key": sample.key, "agent_ids": sample.agent_ids}
            arrays: dict[str, NDArray[Any]] = {f"cloud_{k}": cloud for k, cloud in enumerate(sample.clouds)}
            arrays["poses"] = np.asarray(sample.ego_from_agent, np.float64)
            header, answer = self._ask(question, arrays, Found)
        boxes, score = answer.arrays.get("boxes"), answer.arrays.get("score")
        where = f"{self.text}: {sample.key}"
        return of_arrays(boxes, score, header.classes, self.settings.users, where)

    def close(self) -> None:
        """End the process, or the connection to it."""
        self._end()

    def _ask(
        self, question: Mapping[str, object], arrays: Mapping[str, NDArray[Any]], kind: Any
    ) -> tuple[Any, Message]:
        """Return the header and the answer to a question; a line that failed is closed."""
        try:
            return self._answer(question, arrays, kind)
        except BaseException:
            self._end()
            raise

    def _answer(
        self, question: Mapping[str, object], arrays: Mapping[str, NDArray[Any]], kind: Any
    ) -> tuple[Any, Message]:
        deadline = time.monotonic() + self.answer_s
        self._write(encode(question, arrays), deadline)
        wanted = "hello" if kind is Hello else "boxes"
        try:
            answer = decode(lambda count: self._read(count, deadline))
            said = answer.read(Header).type
            if said == "error":
                message = answer.read(Failure).message
                raise DataError(f"{self.text}: the detector says: {one_line(message, 500) or 'an error'}")
            if said != wanted:
                raise ValueError(f"type: expected {wanted}, found {one_line(said, 40)}")
            return answer.read(kind), answer
        except (ValueError, UnicodeDecodeError) as error:
            raise self._wrong(f"answer to {question['type']}", "a message", one_line(error, 500)) from None

    def _write(self, content: bytes, deadline: float) -> None:
        rest = memoryview(content)
        while rest:
            self._wait(self._line.writes, select.POLLOUT, deadline)
            try:
                rest = rest[os.write(self._line.writes, rest[: 1 << 16]) :]
            except BlockingIOError:
                continue
            except OSError:
                raise self._wrong("process", "one that reads", self._line.ended()) from None

    def _read(self, count: int, deadline: float) -> bytes:
        content = bytearray()
        while len(content) < count:
            self._wait(self._line.reads, select.POLLIN, deadline, bytes(content[:20]))
            try:
                part = os.read(self._line.reads, min(count - len(content), 1 << 20))
            except BlockingIOError:
                continue
            except OSError:
                part = b""
            if not part:
                raise self._wrong("answer", f"{count} bytes", f"{len(content)}, then {self._line.ended()}")
            content += part
        return bytes(content)

    def _wait(self, handle: int, event: int, deadline: float, begun: bytes = b"") -> None:
        poll = select.poll()
        poll.register(handle, event)
        if not poll.poll(max(deadline - time.monotonic(), 0.0) * 1e3):
            after = f" after {begun!r}" if begun else ""
            raise self._wrong("answer", f"one within {self.answer_s:g} s", f"none{after}")

    def _wrong(self, field: str, expected: str, found: str) -> DataError:
        # One line of 80 characters is too short for what a program has to say of its end.
        return DataError(f"{one_line(self.text, 500)}: {field}: expected {expected}, found {one_line(found, 500)}")


class _Program:
    """Line to a program that is started for it; what it writes on standard error is kept for its last line."""

    def __init__(self, text: str) -> None:
        words = command_of(text)
        if not words:
            raise SettingsError(complaint(text, "command", "pipe:COMMAND ..., as a shell has it", "none"))
        self._errors: IO[bytes] = tempfile.TemporaryFile()
        try:
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                bufsize=0,
                start_new_session=True,
            )
        except OSError as error:
            self._errors.close()
            raise DataError(complaint(text, "command", "a program that starts", error.strerror or error)) from None
        if self._process.stdin is None or self._process.stdout is None:
            raise TypeError("a process without pipes")
        self.writes, self.reads = self._process.stdin.fileno(), self._process.stdout.fileno()
        os.set_blocking(self.writes, False)

    def ended(self) -> str:
        try:
            code = self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            return "a closed pipe"
        self._errors.seek(max(self._errors.seek(0, os.SEEK_END) - 4000, 0))
        lines = [line for line in self._errors.read().decode(errors="replace").splitlines() if line.strip()]
        return f"its end with code {code}" + (f": {lines[-1]}" if lines else "")

    def close(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)  # a shell script's children too
            self._process.wait()
        self._errors.close()


class _Port:
    """Line to a program that listens on a port of this machine."""

    def __init__(self, text: str) -> None:
        try:
            split = urlsplit(text)
            host, port = split.hostname, split.port
        except ValueError:
            host, port = None, None
        if host not in _LOCAL or not port:
            raise SettingsError(complaint(text, "address", "tcp://localhost:PORT, on this machine alone", text))
        try:
            self._socket = socket.create_connection((host, port), _END_S)
        except OSError as error:
            shown = error.strerror or str(error)
            raise DataError(complaint(text, "address", "a detector that listens", shown)) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self.reads = self.writes = self._socket.fileno()

    def ended(self) -> str:
        return "a closed connection"

    def close(self) -> None:
        self._socket.close()
