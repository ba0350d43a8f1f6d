"""A detector in a process of its own, over a pipe or a port.

Copy `serve` into the environment of OpenPCDet, mmdetection3d or OpenCOOD; it needs numpy. `dsrc.detectors.message` says
what is sent.

Usage:
    python examples/11_detector_process.py --test
    dsrc evaluate data/test --checkpoint "pipe:python examples/11_detector_process.py" --out results
    python examples/11_detector_process.py --port 5005      # then --checkpoint tcp://localhost:5005
"""

import argparse
import json
import os
import socketserver
import struct
import sys

import numpy as np


def serve(detect, read, write, **hello):
    """Answer until the other end closes: `detect(clouds, poses, header)` returns (N, 7) boxes and (N,) scores."""
    while prefix := read(8):
        header, arrays = json.loads(read(struct.unpack("<4sI", prefix)[1])), {}
        for name, kind, shape in header["arrays"]:
            size = int(kind[1]) * int(np.prod(shape, dtype=np.int64))
            arrays[name] = np.frombuffer(read(size) if size else b"", f"<{kind}").reshape(shape)
        answer, held = {"type": "hello", "protocol": 1, **hello}, {}
        if header["type"] == "detect":
            clouds = [arrays[f"cloud_{k}"] for k in range(len(header["agent_ids"]))]
            boxes, score = detect(clouds, arrays["poses"], header)
            answer = {"type": "boxes"}
            held = {"boxes": np.asarray(boxes, "<f4").reshape(-1, 7), "score": np.asarray(score, "<f4")}
        answer["arrays"] = [(name, "f4", array.shape) for name, array in held.items()]
        content = json.dumps(answer).encode()
        write(struct.pack("<4sI", b"DSRC", len(content)) + content + b"".join(a.tobytes() for a in held.values()))


def serve_pipe(detect, **hello):
    """Answer on standard output; what anything else prints goes to standard error."""
    out = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    serve(detect, sys.stdin.buffer.read, out.write, **hello)


def serve_port(detect, port, **hello):
    """Answer on a port of this machine, one thread for each of dsrc's workers."""

    class Answers(socketserver.StreamRequestHandler):
        def handle(self):
            serve(detect, self.rfile.read, self.wfile.write, **hello)

    with socketserver.ThreadingTCPServer(("127.0.0.1", port), Answers) as server:
        server.serve_forever()


def detect(clouds, poses, header):
    """Put a car where points stand densest in a cell of 4 m; a network goes here."""
    points = np.concatenate(clouds)[:, :3]  # of all agents, x, y, z, m, in the ego LiDAR's frame
    points = points[(points[:, 2] > -1.3) & (points[:, 2] < 0.0)]
    cells, count = np.unique(np.floor(points[:, :2] / 4.0), axis=0, return_counts=True)
    best = np.argsort(-count)[:20]
    boxes = [[4.0 * x + 2.0, 4.0 * y + 2.0, -1.0, 4.5, 1.9, 1.6, 0.0] for x, y in cells[best]]
    return boxes, count[best] / (count[best] + 50.0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--port", type=int)
    parser.add_argument("--test", action="store_true", help="detect in noise")
    options = parser.parse_args()
    hello = {"name": "densest cells, version 1", "range_m": [-51.2, -25.6, -3, 51.2, 25.6, 1]}
    if options.test:
        print(len(detect([np.random.default_rng(0).normal(size=(999, 4))], np.eye(4)[None], {})[0]), "boxes")
    elif options.port:
        serve_port(detect, options.port, **hello)
    else:
        serve_pipe(detect, **hello)
