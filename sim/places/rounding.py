"""Round bends: SUMO turns a vehicle at once where the middle line of its lane has a corner."""

import re

import numpy as np
from numpy.typing import NDArray

REACH_M = 5.0
"""A corner is rounded from so far before it to so far behind it, less where the next corner is nearer."""

_STEPS = 6
_NEVER_HALF = 0.48
_LANE = re.compile(r'(<lane id="[^":][^>]* shape=")([^"]*)(")')


def rounded_network(text: str) -> str:
    """Return the text of a .net.xml with the bends of its streets rounded; lanes within junctions stay as they are.

    The first and last corner of a lane stay where they are, so that it still meets its neighbours.
    """
    return _LANE.sub(lambda found: found[1] + _rounded_shape(found[2]) + found[3], text)


def _rounded_shape(shape: str) -> str:
    line = np.array([[float(value) for value in corner.split(",")] for corner in shape.split()])
    if len(line) < 3:
        return shape
    return " ".join(",".join(f"{value:.3f}" for value in corner) for corner in rounded(line).tolist())


def rounded(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Replace the inner corners of a (K, 2) or (K, 3) line by parabolas that touch both of its legs."""
    length = np.hypot(*np.diff(line[:, :2], axis=0).T)
    share = np.linspace(0.0, 1.0, _STEPS + 1)[:, None]
    parts = [line[:1]]
    for k in range(1, len(line) - 1):
        reach = min(REACH_M, _NEVER_HALF * length[k - 1], _NEVER_HALF * length[k])
        if reach < 0.05:
            parts.append(line[k : k + 1])
            continue
        start = line[k] + (line[k - 1] - line[k]) * reach / length[k - 1]
        end = line[k] + (line[k + 1] - line[k]) * reach / length[k]
        parts.append((1 - share) ** 2 * start + 2 * share * (1 - share) * line[k] + share**2 * end)
    return np.concatenate([*parts, line[-1:]])
