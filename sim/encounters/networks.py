"""Road networks of encounters: nodes and edges in SUMO's plain XML, built by netconvert and cached."""

import math
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

from sim.roads.cache import cached
from sim.roads.tools import Option, drop_header, run_tool

LANE_M = 3.5

_OPTIONS: dict[str, Option] = {"offset.disable-normalization": True, "no-turnarounds": True, "no-warnings": True}


@dataclass(frozen=True, slots=True)
class LaneSpec:
    """Lane of an edge: width, m, and permitted vehicle class ("" for all motor traffic, or `bicycle`)."""

    width: float = LANE_M
    allow: str = ""


@dataclass(frozen=True, slots=True)
class Node:
    """Junction or dead end: id, position, SUMO's type."""

    name: str
    x: float
    y: float
    kind: str = "priority"
    radius_m: float = 6.0


@dataclass(frozen=True, slots=True)
class Edge:
    """One-way road; its lanes lie right of the line from node to node, rightmost first.

    Attributes:
        name: id.
        start: id of a node.
        end: id of a node.
        lanes: from the right.
        speed_mps: limit, m/s.
        priority: the higher one has right of way.
        shape: intermediate points, m.
    """

    name: str
    start: str
    end: str
    lanes: tuple[LaneSpec, ...] = (LaneSpec(),)
    speed_mps: float = 13.89
    priority: int = 1
    shape: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class PlainNetwork:
    """Road network in SUMO's plain form: nodes and edges."""

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]


@dataclass(frozen=True, slots=True)
class Arm:
    """Arm of a junction at the origin.

    Attributes:
        bearing: direction from the junction, rad.
        length_m: of the arm.
        to: lanes that lead to the junction, from the right.
        away: lanes that lead away, from the right.
        speed_mps: limit.
        priority: of the arm.
    """

    bearing: float
    length_m: float = 160.0
    to: tuple[LaneSpec, ...] = (LaneSpec(),)
    away: tuple[LaneSpec, ...] = (LaneSpec(),)
    speed_mps: float = 13.89
    priority: int = 1


def junction(arms: dict[str, Arm], kind: str = "priority", radius_m: float = 6.0) -> PlainNetwork:
    """Return a junction at the origin with arms of these names; its edges are `NAME_in` and `NAME_out`."""
    nodes, edges = [Node("c", 0.0, 0.0, kind, radius_m)], []
    for name, arm in arms.items():
        x, y = arm.length_m * math.cos(arm.bearing), arm.length_m * math.sin(arm.bearing)
        nodes.append(Node(name, x, y))
        if arm.to:
            edges.append(Edge(f"{name}_in", name, "c", arm.to, arm.speed_mps, arm.priority))
        if arm.away:
            edges.append(Edge(f"{name}_out", "c", name, arm.away, arm.speed_mps, arm.priority))
    return PlainNetwork(tuple(nodes), tuple(edges))


def write_roads(name: str, roads: PlainNetwork) -> Path:
    """Return the cached .net.xml of roads; equal roads give equal bytes.

    Args:
        name: name of the scenario, prefix of the file name.

    Raises:
        ScenarioError: netconvert fails.
    """
    plain = {"node": _nodes_xml(roads), "edge": _edges_xml(roads)}

    def make(made: Path) -> None:
        files = {f"{kind}-files": made.with_name(f"{kind}s.xml") for kind in plain}
        for path, text in zip(files.values(), plain.values(), strict=True):
            path.write_text(text, encoding="utf-8")
        options = {option: str(path) for option, path in files.items()}
        run_tool(
            "netconvert", {**options, **_OPTIONS, "output-file": str(made)}, made, f"{name}: the roads of its conflict"
        )
        drop_header(made)

    return cached("networks", name, ".net.xml", [plain, list(_OPTIONS.items())], make)


def _nodes_xml(roads: PlainNetwork) -> str:
    rows = [
        f'<node id={quoteattr(node.name)} x="{node.x:.3f}" y="{node.y:.3f}" type="{node.kind}" '
        f'radius="{node.radius_m:.2f}"/>'
        for node in roads.nodes
    ]
    return "<nodes>\n" + "\n".join(rows) + "\n</nodes>\n"


def _edges_xml(roads: PlainNetwork) -> str:
    rows = []
    for edge in roads.edges:
        shape = ""
        if edge.shape:
            ends = {node.name: (node.x, node.y) for node in roads.nodes}
            line = [ends[edge.start], *edge.shape, ends[edge.end]]
            shape = ' shape="' + " ".join(f"{x:.3f},{y:.3f}" for x, y in line) + '"'
        rows.append(
            f"<edge id={quoteattr(edge.name)} from={quoteattr(edge.start)} to={quoteattr(edge.end)} "
            f'numLanes="{len(edge.lanes)}" speed="{edge.speed_mps:.2f}" priority="{edge.priority}"{shape}>'
        )
        for index, lane in enumerate(edge.lanes):
            allow = f' allow="{lane.allow}"' if lane.allow else ""
            rows.append(f'<lane index="{index}" width="{lane.width:.2f}"{allow}/>')
        rows.append("</edge>")
    return "<edges>\n" + "\n".join(rows) + "\n</edges>\n"
