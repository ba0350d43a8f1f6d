"""Detector in a process of its own: a program that answers over its standard input and output, or on a local port.

So detectors of OpenPCDet, mmdetection3d or OpenCOOD run in their own environment. `examples/11_detector_process.py` is
the other end, to be copied into it; `message.py` says what is sent.
"""

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import Sample, SampleRequest
from dsrc.detectors.answers import of_arrays
from dsrc.detectors.line import ProcessLine
from dsrc.detectors.message import PROTOCOL, Found, Hello
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sim.boxes import VEHICLES, VULNERABLE

ANSWER_S = 300.0
"""Longest time to an answer, s: a large network on a busy CPU; the first also loads the weights."""


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
        self._line = ProcessLine(self.text, "detector")
        hello = self._line.ask({"type": "hello", "protocol": PROTOCOL}, {}, Hello, self.answer_s)[0]
        try:
            grid = GridSpec(hello.range_m)
        except ValueError as error:
            self._line.close()
            raise self._line.wrong("hello: range_m", "minima below maxima", str(error)) from None
        self.name = hello.name
        self.settings = SampleRequest(grid, hello.comm_range_m, hello.max_agents, hello.users)
        self.classes = VEHICLES if hello.users == "vehicles" else VULNERABLE

    def detect(self, sample: Sample) -> Detections:
        """Detect in one sample, best first, in its frame.

        Raises:
            DataError: the process ends, hangs or answers something else; the next sample starts it anew.
        """
        with self._lock:
            if not self._line.usable:
                self._open()
            question = {"type": "detect", "key": sample.key, "agent_ids": sample.agent_ids}
            arrays: dict[str, NDArray[Any]] = {f"cloud_{k}": cloud for k, cloud in enumerate(sample.clouds)}
            arrays["poses"] = np.asarray(sample.ego_from_agent, np.float64)
            header, answer = self._line.ask(question, arrays, Found, self.answer_s)
        boxes, score = answer.arrays.get("boxes"), answer.arrays.get("score")
        where = f"{self.text}: {sample.key}"
        return of_arrays(boxes, score, header.classes, self.settings.users, where)

    def close(self) -> None:
        """End the process, or the connection to it."""
        self._line.close()
