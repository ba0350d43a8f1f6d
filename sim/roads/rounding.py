"""Rounding of lane corners, where SUMO would turn vehicles on the spot, and turning speeds."""

import re

import numpy as np

from sim.geometry import Array

REACH_M = 5.0
"""Rounding distance before and after a corner, m; less where the next corner is nearer."""

TURN_RADPS = 1.4
"""Highest yaw rate, rad/s: tighter junction lanes get a lower speed."""

_BODY_M = 4.0
"""Length over which the turn of a lane is measured, m: that of a car."""

_STEPS = 6
_NEVER_HALF = 0.48
_SLOWEST_MPS = 3.0
_SHORT_M = 150.0
"""Longest street that gets the speed of its tightest bend, m; longer ones keep their limit."""

_LANE = re.compile(r'<lane id="([^"]+)"[^>]*? speed="([^"]+)" length="([^"]+)"[^>]*? shape="([^"]*)"')
_LINK = re.compile(r'<connection from="([^"]+)" to="([^"]+)" fromLane="(\d+)" toLane="(\d+)"[^>]*? via="([^"]+)"')


def rounded_network(text: str) -> str:
    """Return the text of a .net.xml with rounded bends, and speeds at which they can be driven.

    The first and last corner of a lane stay where they are, so that it still meets its neighbours; the lanes within
    junctions, which netconvert has made round, keep their shapes.
    """
    shape = {found[1]: found[4] for found in _LANE.finditer(text)}
    line = {name: line_of(corners) for name, corners in shape.items()}
    line |= {name: rounded(line[name]) for name in line if not name.startswith(":") and len(line[name]) > 2}
    limit = {name: _limit(corners) for name, corners in line.items() if _length(corners) < _SHORT_M}
    for found in _LINK.finditer(text):
        before, via, after = f"{found[1]}_{found[3]}", found[5], f"{found[2]}_{found[4]}"
        if before in line and via in line and after in line:
            way = np.concatenate([_tail(line[before]), line[via][:, :2], _tail(line[after][::-1])[::-1]])
            limit[via] = min(limit.get(via, np.inf), _limit(way))

    def rewrite(found: re.Match[str]) -> str:
        name, speed = found[1], float(found[2])
        whole = found[0].replace(f'shape="{found[4]}"', f'shape="{text_of(line[name])}"')
        # SUMO gives the lanes of a bend one length: on the outer one vehicles are faster than it thinks.
        stretch = max(_length(line[name]) / max(float(found[3]), 0.1), 1.0)
        slower = max(min(limit.get(name, np.inf), speed) / stretch, _SLOWEST_MPS)
        return whole.replace(f'speed="{found[2]}"', f'speed="{slower:.2f}"', 1) if slower < speed else whole

    return _LANE.sub(rewrite, text)


def rounded(line: Array) -> Array:
    """Replace the inner corners of a (K, 2) or (K, 3) line by parabolas tangent to both legs."""
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


def line_of(shape: str) -> Array:
    """Return (K, 2) or (K, 3) corners of the shape of a lane, m."""
    corners = [[float(value) for value in corner.split(",")] for corner in shape.split()]
    # netconvert leaves out heights of 0, corner by corner.
    size = max(map(len, corners))
    return np.array([corner + [0.0] * (size - len(corner)) for corner in corners])


def text_of(line: Array) -> str:
    """Return the shape attribute of lane corners."""
    return " ".join(",".join(f"{value:.3f}" for value in corner) for corner in line.tolist())


def _length(line: Array) -> float:
    return float(np.hypot(*np.diff(line[:, :2], axis=0).T).sum())


def _tail(line: Array) -> Array:
    """Return the last metres of a line, (K, 2), over the length of a body."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
    at = np.unique(np.concatenate([[max(along[-1] - _BODY_M, 0.0)], along[along > along[-1] - _BODY_M]]))
    return np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)])


def _limit(line: Array) -> float:
    """Return the highest speed on a line within `TURN_RADPS`, m/s."""
    way = np.diff(line[:, :2], axis=0)
    length = np.hypot(*way.T)
    way, length = way[length > 1e-3], length[length > 1e-3]
    if len(way) < 2:
        return np.inf
    turned = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    along = np.concatenate([[0.0], np.cumsum(length)])
    at = np.arange(0.0, along[-1], 0.25)
    heading = turned[np.searchsorted(along[1:], at, side="right").clip(max=len(turned) - 1)]
    reach = min(round(_BODY_M / 0.25), len(heading))
    most = np.ptp(np.lib.stride_tricks.sliding_window_view(heading, reach), axis=1).max()
    return float(TURN_RADPS * _BODY_M / most) if most > 1e-6 else np.inf
