"""A driver in a process of its own, over a pipe or a port.

Copy `serve` into a policy's environment; it needs numpy. `dsrc.closed_loop.driving.own.process` says what is sent.

Usage:
    python examples/13_driver_process.py --test
    dsrc drive eebl_chain --driver "pipe:python examples/13_driver_process.py"
    python examples/13_driver_process.py --port 5006      # then --driver tcp://localhost:5006
"""

import argparse
import json
import os
import socketserver
import struct
import sys
from importlib import import_module

import numpy as np


def serve(driver, read, write, **hello):
    """Answer until the other end closes: `driver()` begins an episode, `decide(header, arrays)` returns m/s2."""
    now = driver()
    while prefix := read(8):
        header, arrays = json.loads(read(struct.unpack("<4sI", prefix)[1])), {}
        for name, kind, shape in header["arrays"]:
            size = int(kind[1]) * int(np.prod(shape, dtype=np.int64))
            arrays[name] = np.frombuffer(read(size) if size else b"", f"<{kind}").reshape(shape)
        answer, held = {"type": "hello", "protocol": 1, "role": "driver", **hello}, b""
        if header["type"] == "reset":
            now, answer = driver(), {"type": "ready"}
        if header["type"] == "decide":
            held = struct.pack("<d", now.decide(header, arrays))
            answer = {"type": "decision", "arrays": [("decision", "f8", (1,))]}
        content = json.dumps(answer).encode()
        write(struct.pack("<4sI", b"DSRC", len(content)) + content + held)


class Driver:
    """Driver of one episode by the law of `12_highway_env_driver.py`; a policy goes here."""

    law = staticmethod(import_module("12_highway_env_driver").acceleration)

    def decide(self, header, arrays):
        """Return the acceleration, m/s2."""
        ego, length = header["ego"], arrays["ego_box"][3]
        return self.law(
            ego["speed_mps"], ego["limit_mps"], length, arrays["route"], arrays["boxes"], arrays["velocity"]
        )


class Answers(socketserver.StreamRequestHandler):
    """One of dsrc's workers at a port of this machine."""

    def handle(self):  # noqa: D102
        serve(Driver, self.rfile.read, self.wfile.write, **HELLO)


HELLO = {"name": "highway-env's IDMVehicle", "wants": []}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--port", type=int)
    parser.add_argument("--test", action="store_true", help="drive beside 12_highway_env_driver.py in dsrc's loop")
    options = parser.parse_args()
    if options.test:
        import dsrc

        for text in ("12_highway_env_driver:Idm", f"pipe:{sys.executable} {os.path.abspath(__file__)}"):
            loop = dsrc.ClosedLoop("eebl_chain", dsrc.open_perception("truth"), dsrc.open_driver(text))
            print(f"{loop.run(0)} after {loop.tick.ego.progress_m:.9f} m by {text.split()[-1]}")
    elif options.port:
        with socketserver.ThreadingTCPServer(("127.0.0.1", options.port), Answers) as server:
            server.serve_forever()
    else:
        out = os.fdopen(os.dup(1), "wb", buffering=0)
        os.dup2(2, 1)  # what anything else prints goes to standard error
        serve(Driver, sys.stdin.buffer.read, out.write, **HELLO)
