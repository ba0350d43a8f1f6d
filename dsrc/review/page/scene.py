"""SceneWriter: FrameViews drawn into a viser scene, one named node each, updated in place."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser.transforms import SO3

from dsrc.review import palette, shapes
from dsrc.review.page.cameras import FOV_RAD, CameraPose
from dsrc.review.palette import Rgb
from dsrc.review.sources.moment import CELL_M
from dsrc.review.state import EPISODE_LAYERS, Theme
from dsrc.review.static import StaticPart, body_shape
from dsrc.review.texts import ruler_report
from dsrc.review.view import (
    DETECTED_TRUTH,
    FALSE_NEGATIVES,
    FALSE_POSITIVES,
    LAYERS,
    OTHER_TRUTH,
    SELECTED,
    TRUE_POSITIVES,
    UNJUDGED,
    AgentView,
    FrameView,
)
from sensors.sweep import SCATTERED
from sim.boxes import CLASSES, Boxes


@dataclass(frozen=True, slots=True)
class BoxStyle:
    """Style of a box layer: colour, None for that of lines, line width in pixels, form, opacity of the faces."""

    rgb: Rgb | None
    thickness: float
    form: str = "solid"
    fill: float = 0.0


STYLES = {
    OTHER_TRUTH: BoxStyle(palette.OTHER, 1.0),
    DETECTED_TRUTH: BoxStyle(None, 1.5),
    FALSE_NEGATIVES: BoxStyle(palette.FN, 5.0, "dashed", 0.4),
    TRUE_POSITIVES: BoxStyle(palette.TP, 2.5, "solid", 0.16),
    FALSE_POSITIVES: BoxStyle(palette.FP, 4.0, "crossed", 0.25),
    UNJUDGED: BoxStyle(None, 2.5, "solid", 0.16),
    SELECTED: BoxStyle(None, 6.0),
}
_FORMS = {"solid": shapes.edges, "dashed": shapes.dashed, "crossed": shapes.crossed, "roof": shapes.roof_crosses}
_NO_LINES = np.zeros((0, 2, 3), np.float32)


AROUND_M = 0.12
"""Width by which the boxes of each further method are drawn larger, m: they do not cover those of the others."""
FRAME_M = 0.4
"""Width by which the selected box is drawn larger, m: a frame around its verdict, on the same ground."""
RINGS_M = (10, 25, 50, 75, 100)
"""Radii of the circles around the ego, m."""
CUT_M = 1.0
"""Height above the start of the ego at which walls and plants are cut, m."""
_CUT = ("buildings", "plants")
THIN = 0.4
"""Size of points that a corruption made, as a share of that of the others: snow would cover the boxes."""
PLAN_M = 0.25
"""Height of the drawn plan and route above the road, m."""


@dataclass(frozen=True, slots=True)
class Clicked:
    """Box that was clicked: an object by its id, or a detection by its place in the order of the scores."""

    object_id: int | None = None
    detection: int | None = None


def set_light(scene: viser.SceneApi) -> None:
    """Set the light of all themes: horizontal faces have the colour that they are given, upright ones are darker."""
    # The default environment map washes colours out.
    scene.configure_environment_map(None)
    scene.configure_default_lights(False)
    scene.add_light_ambient("/light/ambient", intensity=0.6 * np.pi)
    sun = np.array([-0.4, 0.6, 1.0])
    strength = 0.4 * np.pi * float(np.linalg.norm(sun)) / sun[2]
    scene.add_light_directional("/light/sun", intensity=strength, position=tuple(sun))
    scene.world_axes.visible = False


def backdrop(theme: Theme, height_px: int = 256) -> NDArray[np.uint8]:
    """(H, 3) colours of a theme's sky from the top down."""
    height = np.linspace(0.0, 1.0, height_px)[:, None]
    sky = np.array(palette.LOOKS[theme].sky, np.float64)
    # Bluer upwards, towards the ground beyond the drawn world below.
    return np.clip(sky - (0.5 - height) * np.array([22.0, 12.0, 4.0]), 0, 255).astype(np.uint8)


def set_sky(scene: viser.SceneApi, theme: Theme) -> None:
    """Set the background image of a theme."""
    scene.set_background_image(np.repeat(backdrop(theme)[:, None], 4, axis=1), format="png")


class SceneWriter:
    """Writer of the nodes below `root`; not thread-safe.

    Attributes:
        scene: of a server or of one browser.
        root: root node.
        point_step_m: grid to which points are rounded, m; 0 for none.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        root: str = "",
        point_step_m: float = 0.0,
        on_click: Callable[[Clicked], None] | None = None,
    ) -> None:
        """Draw nothing yet.

        Args:
            point_step_m: round points to a grid of this step, which packs better; 0 keeps them.
            on_click: called with the object or detection that is clicked.
        """
        self.scene = scene
        self.root = root
        self.point_step_m = point_step_m
        self._nodes: dict[str, Any] = {}
        # View of each cloud: an unchanged one is not sent again.
        self._drawn: dict[str, AgentView] = {}
        self._look = palette.LOOKS["light"]
        self._on_click = on_click
        self._clickable: dict[str, tuple[Clicked, ...]] = {}

    def clear(self) -> None:
        """Remove every node of the drive."""
        # Children first: viser warns about a handle whose parent took it away.
        for name in sorted(self._nodes, key=len, reverse=True):
            self._nodes[name].remove()
        for kept in (self._nodes, self._drawn, self._clickable):
            kept.clear()

    def place_world(self, parts: Sequence[StaticPart], theme: Theme, cut: bool = False) -> None:
        """Draw the static world of a drive, or a grid without one; where it is placed, colours and height change.

        Args:
            cut: let walls and plants end at `CUT_M`.
        """
        self._frame("world")
        look = palette.LOOKS[theme]
        if not parts and "world/grid" not in self._nodes:
            self._nodes["world/grid"] = self.scene.add_grid(
                f"{self.root}/world/grid",
                width=400.0,
                height=400.0,
                cell_size=5.0,
                cell_color=look.grid[0],
                section_size=25.0,
                section_color=look.grid[1],
                position=(0.0, 0.0, -0.05),
                fade_distance=260.0,
            )
        if "world/grid" in self._nodes:
            self._nodes["world/grid"].cell_color, self._nodes["world/grid"].section_color = look.grid
        for part in parts:
            name, vertices = f"world/{part.name}", part.vertices
            if cut and part.name in _CUT:
                vertices = np.minimum(vertices, np.array([np.inf, np.inf, CUT_M], np.float32))
            if name in self._nodes:
                self._nodes[name].color, self._nodes[name].vertices = look.world[part.name], vertices
                continue
            self._nodes[name] = self.scene.add_mesh_simple(
                f"{self.root}/{name}",
                vertices,
                part.faces,
                color=look.world[part.name],
                opacity=part.opacity,
                flat_shading=True,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )

    def write(self, view: FrameView) -> None:
        """Draw a frame; the caller groups it with `atomic()`."""
        self._look = palette.LOOKS[view.state.theme]
        for agent in view.agents:
            self._write_agent(agent, view)
        drawn = {_agent_node(agent) for agent in view.agents}
        for name in [name for name in self._nodes if name.count("/") == 1 and name.startswith("agents/")]:
            self._nodes[name].visible = name in drawn
        self._write_bodies(view)
        for name in LAYERS:
            off = name.split("/")[0] in view.state.layers_off
            style = STYLES[name]
            if name == DETECTED_TRUTH and view.counts is not None:
                # A detected object lies under its detection: a hairline is enough.
                style = STYLES[OTHER_TRUTH]
            if view.state.color_by != "verdict" and name != OTHER_TRUTH:
                # Colour tells one thing at a time; their forms say which are right and which wrong.
                style = replace(style, rgb=None)
            boxes = view.layers[name]
            if name == SELECTED:
                raised = boxes.center + np.array([0.0, 0.0, 0.5 * FRAME_M])
                boxes = replace(boxes, center=raised, size=boxes.size + FRAME_M)
            self._write_boxes(name, boxes, style, not off)
            if style.fill > 0.0:
                self._make_clickable(f"{name}/faces", _boxes_clicked(view, name))
        for name in ("helped", "compared"):
            self._frame(name).visible = "detections" not in view.state.layers_off
        self._write_help(view)
        self._write_compared(view)
        self._frame("links").visible = "links" not in view.state.layers_off
        self._lines("links/heard", view.linked.astype(np.float32), palette.OTHER, 1.0)
        self._write_moment(view)
        self._write_rings(view)
        self._write_ruler(view)
        self._frame("world").visible = "world" not in view.state.layers_off

    def _write_rings(self, view: FrameView) -> None:
        """Draw circles around the ego, with their radii ahead of it."""
        around = np.linspace(0.0, 2.0 * np.pi, 73)
        circle = np.stack([np.cos(around), np.sin(around), 0.0 * around], axis=1)
        place = view.ego.review_from_body[:3, 3] + [0.0, 0.0, PLAN_M]
        lines = [shapes.polyline(place + radius * circle) for radius in RINGS_M] if view.state.rings else [_NO_LINES]
        self._lines("rings/circles", np.concatenate(lines), self._look.ink, 1.0)
        for radius in RINGS_M:
            ahead = place + radius * view.ego.review_from_body[:3, 0]
            self._label(f"rings/{radius}", f"{radius} m", ahead, view.state.rings)

    def _write_ruler(self, view: FrameView) -> None:
        """Draw the ruler with what it measures, or a mark at its first end."""
        ends = np.array(view.state.ruler, np.float64).reshape(-1, 2)
        ground = view.ego.review_from_body[2, 3]
        ends = np.column_stack([ends, np.full(len(ends), ground + 2.0 * PLAN_M)])
        posts = np.stack([ends, ends + np.array([0.0, 0.0, 1.0])], axis=1).astype(np.float32)
        lines = np.concatenate([posts, shapes.polyline(ends)]) if len(ends) else _NO_LINES
        self._lines("ruler/line", lines, self._look.ink, 4.0)
        said = ruler_report(view)
        self._label("ruler/text", said, ends.mean(axis=0) if said else np.zeros(3), bool(said))

    def _label(self, name: str, text: str, place: NDArray[np.float64], shown: bool, **where: Any) -> None:
        if name not in self._nodes:
            self._frame(name.split("/")[0])
            self._nodes[name] = self.scene.add_label(f"{self.root}/{name}", text, font_screen_scale=0.7, **where)
        node = self._nodes[name]
        node.visible = shown
        if shown:
            node.text, node.position = text, tuple(place)

    def _write_agent(self, agent: AgentView, view: FrameView) -> None:
        name = _agent_node(agent)
        self._frame("agents")
        self._frame(name)
        lidar = self._frame(f"{name}/lidar")
        place_frame(lidar, agent.review_from_lidar)
        size_m, kept = view.state.point_size_m, len(agent.points) - agent.made
        for part, points, colors, part_size_m in (
            ("points", agent.points[:kept], agent.colors[:kept], size_m),
            ("made", agent.points[kept:], agent.colors[kept:], THIN * size_m),
            ("lost", agent.lost_points, np.array(palette.LOST, np.uint8), size_m),
        ):
            self._write_cloud(f"{name}/lidar/{part}", agent, points, colors, part_size_m)
        # The others have their colour and the legend; the name that is asked for is shown.
        asked = agent.is_ego or agent.agent_id == getattr(view.details, "object_id", None)
        shown = asked and "labels" not in view.state.layers_off
        place = agent.review_from_lidar[:3, 3] + [0.0, 0.0, 1.2]
        self._label(f"{name}/label", "EGO" if agent.is_ego else agent.title, place, shown, anchor="bottom-center")

    def _write_cloud(
        self, name: str, agent: AgentView, points: NDArray[np.float32], colors: NDArray[np.uint8], point_size_m: float
    ) -> None:
        node, drawn = self._nodes.get(name), self._drawn.get(name) is agent
        self._drawn[name] = agent
        if len(points) == 0:
            self._hide(name)
            return
        if not drawn and self.point_step_m > 0.0:
            points = np.round(points / self.point_step_m) * np.float32(self.point_step_m)
        if node is None:
            node = self._nodes[name] = self.scene.add_point_cloud(
                f"{self.root}/{name}", points, colors, point_shape="circle", point_shading="flat"
            )
        elif not drawn:
            _send(node, "points", points.astype(np.float16))
            _send(node, "colors", colors)
        node.point_size, node.visible = point_size_m, True

    def _write_bodies(self, view: FrameView) -> None:
        self._frame("bodies").visible = "bodies" not in view.state.layers_off
        colors = np.full((len(view.truth), 3), self._look.body, np.uint8)
        for row, agent in enumerate(view.agents):
            if agent.is_ego or view.state.color_by == "agent":
                colors[view.agent_of == row] = agent.rgb
        base = view.truth.center - [0.0, 0.0, 0.5] * view.truth.size
        for label, class_name in enumerate(CLASSES):
            name, rows = f"bodies/{class_name}", view.truth.label == label
            if not rows.any():
                self._hide(name)
                continue
            pose = (shapes.quaternions(view.truth.yaw[rows]), base[rows], view.truth.size[rows])
            self._batch(name, body_shape(class_name), pose, colors[rows], opacity=None)
            clicked = tuple(Clicked(object_id=number) for number in view.truth.object_id[rows].tolist())
            self._make_clickable(name, clicked)

    def _make_clickable(self, name: str, clicked: tuple[Clicked, ...]) -> None:
        if self._on_click is None or name not in self._nodes:
            return
        known = name in self._clickable
        self._clickable[name] = clicked
        if known:
            return

        @self._nodes[name].on_click
        def _(event: Any) -> None:
            boxes = self._clickable.get(name, ())
            if self._on_click is not None and event.instance_index is not None and event.instance_index < len(boxes):
                self._on_click(boxes[event.instance_index])

    def _write_boxes(self, name: str, boxes: Boxes, style: BoxStyle, shown: bool) -> None:
        self._frame(name.split("/")[0])
        self._frame(name).visible = shown
        lines = _FORMS[style.form](boxes) if len(boxes) else _NO_LINES
        rgb = style.rgb or self._look.ink
        self._lines(f"{name}/edges", lines, rgb, style.thickness)
        if style.fill > 0.0:
            pose = (shapes.quaternions(boxes.yaw), boxes.center, boxes.size)
            colors = np.tile(np.array(rgb, np.uint8), (len(boxes), 1))
            self._batch(f"{name}/faces", (shapes.CUBE_VERTICES, shapes.CUBE_FACES), pose, colors, style.fill)

    def _write_help(self, view: FrameView) -> None:
        """Draw boxes in the colour of the agent to whom most of their score is due."""
        drawn: list[tuple[str, Boxes, BoxStyle]] = []
        if (help := view.help) is not None:
            for row, (found, made) in enumerate(zip(help.found, help.made, strict=True)):
                rgb = palette.agent_color(row)
                drawn.append((f"helped/{row}/found", found, BoxStyle(rgb, 3.0, "solid", 0.25)))
                drawn.append((f"helped/{row}/made", made, BoxStyle(rgb, 3.0, "crossed", 0.25)))
            drawn.append(("helped/missed", help.missed, STYLES[FALSE_NEGATIVES]))
            drawn.append(("helped/harmed", help.harmed, BoxStyle(palette.FP, 4.0, "roof")))
        for name, boxes, style in drawn:
            self._write_boxes(name, boxes, style, len(boxes) > 0)
        self._hide_others("helped", [name for name, _, _ in drawn])

    def _write_compared(self, view: FrameView) -> None:
        """Draw the boxes of further methods, each in its colour and a little around those of the others."""
        for row, method in enumerate(view.compared):
            for kind, form in (("hits", shapes.edges), ("false", shapes.crossed), ("missed", shapes.dashed)):
                boxes = getattr(method, kind)
                around = replace(boxes, size=boxes.size + AROUND_M * (row + 1))
                self._lines(f"compared/{row}/{kind}", form(around), palette.method_color(row + 1), 2.5)
        self._hide_others("compared", [f"compared/{row}/" for row in range(len(view.compared))])

    def _hide_others(self, parent: str, drawn: Sequence[str]) -> None:
        """Hide the nodes below a parent whose names begin otherwise."""
        for name in self._nodes:
            if name.startswith(f"{parent}/") and not name.startswith(tuple(drawn)):
                self._nodes[name].visible = False

    def _write_moment(self, view: FrameView) -> None:
        """Draw what the ego of an episode plans, tracks, hears and is made to believe; hide it elsewhere."""
        moment = view.moment
        for name in EPISODE_LAYERS:
            self._frame(name).visible = moment is not None and name not in view.state.layers_off
        if moment is None:
            return
        ground = view.ego.review_from_body[2, 3] + PLAN_M
        plan = moment.plan[:, :3] + [0.0, 0.0, PLAN_M]
        route = np.column_stack([moment.route, np.full(len(moment.route), ground)])
        self._lines("plan/route", shapes.dashed_lines(shapes.polyline(route), 1.0), palette.OTHER, 1.5)
        self._lines("plan/way", shapes.polyline(plan), view.ego.rgb, 7.0)
        decisive = moment.tracks.object_id == moment.decisive
        heading = np.column_stack([np.nan_to_num(moment.track_velocity), np.zeros(len(moment.tracks))])
        ahead = np.stack([moment.tracks.center, moment.tracks.center + heading], axis=1).astype(np.float32)
        self._lines("tracks/boxes", shapes.edges(moment.tracks[~decisive]), palette.method_color(1), 1.5)
        self._lines("tracks/decisive", shapes.edges(moment.tracks[decisive]), palette.method_color(1), 5.0)
        self._lines("tracks/second_ahead", ahead, palette.method_color(1), 2.0)
        self._lines("claims/boxes", shapes.crossed(moment.claims), palette.FATE_COLORS[SCATTERED], 3.0)
        line, heard = moment.links.line.astype(np.float32), moment.links.received
        placed = np.isfinite(line).all(axis=(1, 2))
        self._lines("links/received", line[placed & heard], view.ego.rgb, 2.0)
        self._lines("links/lost", shapes.dashed_lines(line[placed & ~heard], 1.5), palette.FP, 2.0)
        self._write_unseen(moment.unseen, view.ego.review_from_lidar[:2, 3], ground)
        touched = view.truth[view.agent_of == 0] if moment.contact is not None else Boxes.zeros()
        self._lines("plan/contact", shapes.crossed(replace(touched, size=touched.size + 0.5)), palette.FP, 8.0)

    def _write_unseen(self, unseen: NDArray[np.bool_] | None, xy: NDArray[np.float64], ground_m: float) -> None:
        """Shade the road where nobody whose sweep arrived sees it."""
        if unseen is None:
            self._hide("seen/shade")
            return
        picture = np.where(unseen[..., None], np.array(palette.UNSEEN, np.uint8), np.uint8(0))
        if "seen/shade" not in self._nodes:
            size = CELL_M * len(unseen)
            self._nodes["seen/shade"] = self.scene.add_image(
                f"{self.root}/seen/shade", picture, size, size, format="png", cast_shadow=False, receive_shadow=False
            )
        node = self._nodes["seen/shade"]
        node.image, node.position, node.visible = picture, (*xy, ground_m), True

    def _lines(self, name: str, lines: NDArray[np.float32], rgb: Rgb, thickness: float) -> None:
        if len(lines) == 0:
            self._hide(name)
            return
        node = self._nodes.get(name)
        # One colour for all: viser shows colours per vertex too pale, as if they were linear.
        color = np.array(rgb, np.uint8)
        if node is None:
            self._nodes[name] = self.scene.add_line_segments(
                f"{self.root}/{name}", lines, color, thickness=thickness, thickness_units="screen"
            )
            return
        node.points, node.colors = lines, color
        node.thickness = thickness
        node.visible = True

    def _batch(
        self,
        name: str,
        shape: tuple[NDArray[np.float32], NDArray[np.uint32]],
        pose: tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]],
        colors: NDArray[np.uint8],
        opacity: float | None,
    ) -> None:
        """Draw N instances of a unit shape at (quaternions, positions, sizes)."""
        if len(colors) == 0:
            self._hide(name)
            return
        node = self._nodes.get(name)
        colors = palette.linear(colors)
        wxyz, position, size = (np.asarray(part, np.float32) for part in pose)
        if node is None:
            self._nodes[name] = self.scene.add_batched_meshes_simple(
                f"{self.root}/{name}",
                *shape,
                batched_wxyzs=wxyz,
                batched_positions=position,
                batched_scales=size,
                batched_colors=colors,
                opacity=opacity,
                flat_shading=True,
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
            return
        node.batched_wxyzs, node.batched_positions = wxyz, position
        node.batched_scales, node.batched_colors = size, colors
        node.visible = True

    def _hide(self, name: str) -> None:
        if name in self._nodes:
            self._nodes[name].visible = False

    def _frame(self, name: str) -> Any:
        if name not in self._nodes:
            self._nodes[name] = self.scene.add_frame(f"{self.root}/{name}", show_axes=False)
        return self._nodes[name]


def _agent_node(agent: AgentView) -> str:
    return f"agents/{'ego ' if agent.is_ego else ''}{agent.name}".replace(" ", "_")


def _boxes_clicked(view: FrameView, layer: str) -> tuple[Clicked, ...]:
    """What a click on each box of a layer selects."""
    if layer in view.ranks:
        return tuple(Clicked(detection=rank) for rank in view.ranks[layer].tolist())
    return tuple(Clicked(object_id=number) for number in view.layers[layer].object_id.tolist())


def set_start_camera(server: viser.ViserServer, pose: CameraPose) -> None:
    """Set the initial camera of pages opened later and of exported pages."""
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up = tuple(pose.position), tuple(pose.look_at), tuple(pose.up)
    camera.fov = FOV_RAD
    camera.near, camera.far = 0.5, 2000.0


def _send(node: Any, name: str, values: NDArray) -> None:
    """Send an array of a node, in the type of the wire; it must not change after that.

    Assigned, it would be compared with the last one and copied twice, which takes as long as all the rest of a frame.
    """
    node._queue_update(name, values)


def place_frame(handle: Any, parent_from_child: NDArray[np.float64]) -> None:
    """Set the pose of a node to a (4, 4) transform."""
    handle.wxyz = SO3.from_matrix(parent_from_child[:3, :3]).wxyz
    handle.position = parent_from_child[:3, 3]
