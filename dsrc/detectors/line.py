"""Line to a process of others: a program that is started for it, or one that listens on a port of this machine.

Questions and answers are messages of `message.py`, one answer to each question.
"""

import hashlib
import os
import select
import signal
import socket
import subprocess
import tempfile
import time
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, Protocol
from urllib.parse import urlsplit

import msgspec
from numpy.typing import NDArray

from dsrc.detectors.message import Failure, Header, Message, T, decode, encode
from dsrc.detectors.texts import command_of
from sim.errors import DataError, SettingsError, complaint, notice, one_line
from sim.files import file_sha256
from sim.settings import convert

_END_S = 2.0
_TOLD_S = 5.0
"""Time from which on a user is told that an answer is waited for, s."""
_LOCAL = ("localhost", "127.0.0.1", "::1")


class _Way(Protocol):
    """Two-way line of bytes to a process."""

    reads: int
    writes: int

    def ended(self) -> str:
        """Return what is known of the end of the process."""
        ...

    def close(self) -> None:
        """Close the line, and end a process that was started for it."""
        ...


class ProcessLine:
    """Line to a process; one that failed is closed.

    Args:
        text: `pipe:COMMAND ...`, without a shell, or `tcp://localhost:PORT`.
        what: the process is, for messages: detector or driver.

    Raises:
        SettingsError: the text names no command or no local port.
        DataError: the process does not start, or nobody listens.
    """

    def __init__(self, text: str, what: str) -> None:
        self.text, self._what = text, what
        self._way: _Way = _Port(text, what) if text.startswith("tcp:") else _Program(text)
        self._process_id = os.getpid()
        self._end = weakref.finalize(self, self._way.close)

    @property
    def usable(self) -> bool:
        """Whether it is open, and of this process: a line that a fork has copied is another's."""
        return self._process_id == os.getpid() and self._end.alive

    def close(self) -> None:
        """End the process, or the connection to it."""
        self._end()

    def ask(
        self, question: Mapping[str, object], arrays: Mapping[str, NDArray[Any]], kind: type[T], answer_s: float
    ) -> tuple[T, Message]:
        """Return the header and the whole of the answer to a question.

        Args:
            question: header, with its `type`.
            arrays: of the question.
            kind: of the answer's header.
            answer_s: longest time to the answer, s.

        Raises:
            DataError: the process ends, hangs, says an error or something else.
        """
        try:
            return self._answer(question, arrays, kind, answer_s)
        except BaseException:
            self._end()
            raise

    def _answer(
        self, question: Mapping[str, object], arrays: Mapping[str, NDArray[Any]], kind: type[T], answer_s: float
    ) -> tuple[T, Message]:
        self._answer_s, deadline = answer_s, time.monotonic() + answer_s
        asked = f"answer to {question['type']}"
        self._write(encode(question, arrays), deadline)
        try:
            answer = decode(lambda count: self._read(count, deadline))
            said = answer.read(Header).type
            if said == "error":
                message = self._header(answer, Failure, asked).message
                raise DataError(f"{self.text}: the {self._what} says: {one_line(message, 500) or 'an error'}")
            if said != kind.SAID:
                raise ValueError(f"type: expected {kind.SAID}, found {one_line(said, 40)}")
            return self._header(answer, kind, asked), answer
        except ValueError as error:  # it says what was expected
            raise DataError(f"{one_line(self.text, 500)}: {asked}: {one_line(error, 500)}") from None

    def _header(self, answer: Message, kind: type[T], asked: str) -> T:
        return convert(msgspec.json.decode(answer.header), kind, one_line(self.text, 500), DataError, field=asked)

    def _write(self, content: bytes, deadline: float) -> None:
        rest = memoryview(content)
        while rest:
            self._wait(self._way.writes, select.POLLOUT, deadline)
            try:
                rest = rest[os.write(self._way.writes, rest[: 1 << 16]) :]
            except BlockingIOError:
                continue
            except OSError:
                raise self.wrong("process", "one that reads", self._way.ended()) from None

    def _read(self, count: int, deadline: float) -> bytes:
        content = bytearray()
        while len(content) < count:
            self._wait(self._way.reads, select.POLLIN, deadline, bytes(content[:20]))
            try:
                part = os.read(self._way.reads, min(count - len(content), 1 << 20))
            except BlockingIOError:
                continue
            except OSError:
                part = b""
            if not part:
                raise self.wrong("answer", f"{count} bytes", f"{len(content)}, then {self._way.ended()}")
            content += part
        return bytes(content)

    def _wait(self, handle: int, event: int, deadline: float, begun: bytes = b"") -> None:
        poll = select.poll()
        poll.register(handle, event)
        if deadline - time.monotonic() > _TOLD_S and not poll.poll(_TOLD_S * 1e3):
            notice(f"{one_line(self.text, 500)}: no answer yet, which may take up to {self._answer_s:g} s")
        if not poll.poll(max(deadline - time.monotonic(), 0.0) * 1e3):
            after = f" after {begun!r}" if begun else ""
            raise self.wrong("answer", f"one within {self._answer_s:g} s", f"none{after}")

    def wrong(self, field: str, expected: str, found: str) -> DataError:
        """Return the error of something else than was expected of the process."""
        # One line of 80 characters is too short for what a program has to say of its end.
        return DataError(f"{one_line(self.text, 500)}: {field}: expected {expected}, found {one_line(found, 500)}")


def process_sha256(text: str, name: str) -> str:
    """Return the SHA-256 of a process: of its command or address, the name that it says, and files of its command."""
    words = command_of(text) if text.startswith("pipe:") else []
    files = {word: file_sha256(Path(word)) for word in words if Path(word).is_file()}
    return hashlib.sha256(msgspec.json.encode([text, name, files], order="deterministic")).hexdigest()


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

    def __init__(self, text: str, what: str) -> None:
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
            raise DataError(complaint(text, "address", f"a {what} that listens", shown)) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self.reads = self.writes = self._socket.fileno()

    def ended(self) -> str:
        return "a closed connection"

    def close(self) -> None:
        self._socket.close()
