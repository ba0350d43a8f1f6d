"""Sensor lab: a sensor of any preset on an agent or a pole, whose sweep of this instant is cast anew while it moves."""

import logging
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser.transforms import SO3

from dsrc.review.labs.placement import Cast, Placement
from dsrc.review.page.controls import Choice, Control, named
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields
from dsrc.review.page.scene import place_frame
from dsrc.review.page.stage import root_of
from dsrc.review.palette import SENSOR
from dsrc.review.points import subsample
from dsrc.review.texts import quoted, thousands
from dsrc.review.view import AgentView
from dsrc.review.worker import Latest
from sensors.presets import LIDARS, get_lidar
from sensors.spec import LidarSpec
from sim.errors import DataError, UserError, complaint
from sim.geometry import invert, pose_angles

log = logging.getLogger(__name__)

PAUSE_S = 0.08
"""Least time between two sweeps of a sensor that moves, s."""

_ON_POLE = Placement((6.0, 6.0, 5.0))
_ON_MAST = Placement((0.0, 0.0, 5.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Wish:
    """Sweep that is asked for.

    Attributes:
        key: what it depends on; equal keys give equal sweeps.
        drive: row of the drive.
        index: number of the frame.
        time_s: of the frame.
        spec: the sensor.
        placement: on its carrier.
        carrier: agent that it moves with; None for what stands.
        review_from_body: (4, 4) of the carrier.
        max_points: most points drawn.
    """

    key: tuple[Any, ...]
    drive: int
    index: int
    time_s: float
    spec: LidarSpec
    placement: Placement
    carrier: int | None
    review_from_body: NDArray[np.float64]
    max_points: int

    @property
    def review_from_lidar(self) -> NDArray[np.float64]:
        """(4, 4)."""
        return self.review_from_body @ self.placement.matrix


def usual_place(spec: LidarSpec, agent: AgentView | None, height_m: float) -> Placement:
    """Place of a sensor without one of its own: the preset's on a vehicle, 5 m above the ground elsewhere.

    Args:
        agent: its carrier; None for a pole.
    """
    if agent is None:
        return _ON_POLE
    if agent.kind == "roadside":
        return _ON_MAST
    from sensors.recording.mounting import mount

    x, y, z = mount(spec, height_m)[:3, 3].tolist()
    return Placement((x, y, z))


def _carriers(shown: Shown) -> dict[str, Any]:
    agents = () if shown.view is None else shown.view.agents
    return {"ego": "ego", "pole": "pole", **{agent.name: str(agent.agent_id) for agent in agents}}


class SensorLabPanel(Panel):
    """Folder with the sensor, its carrier and its place; its gizmo and its points are nodes of the scene."""

    title = "Sensor lab"
    table = (
        Control("sensor", Choice(named({"none": "", **{name: name for name in LIDARS}})), "Sensor", link="sensor"),
        Control(
            "carrier",
            Choice(_carriers, closed=False),
            "Carrier",
            link="carrier",
            enabled=lambda shown: bool(shown.state.sensor),
        ),
        Control("placement", None, link="placement"),
    )

    def build(self) -> None:
        """Add the widgets; without a sensor nothing is drawn."""
        super().build()
        self._latest = Latest(PAUSE_S)
        self._nodes: dict[str, Any] = {}
        self._root = ""
        self._wish: _Wish | None = None
        self._written: dict[str, tuple[float, ...]] = {}
        self._dragged: Placement | None = None
        self.cast: Cast | None = None
        gui = self._page.gui
        self.position = gui.add_vector3("Position, m", (0.0, 0.0, 0.0), step=0.1, visible=False)
        self.angles = gui.add_vector2("Yaw, pitch, °", (0.0, 0.0), step=1.0, visible=False)
        self.usual = gui.add_button("Usual place", visible=False)
        self.text = gui.add_markdown("", visible=False)
        self.position.on_update(self._take)
        self.angles.on_update(self._take)
        self.usual.on_click(lambda _: self._page.update(placement=()))
        self._page.on_close(self.close)

    def show(self, shown: Shown) -> None:
        """Set the controls and the gizmo, and ask for the sweep where anything that it depends on has changed."""
        super().show(shown)
        for handle in (self.position, self.angles, self.usual, self.text):
            set_fields(handle, visible=bool(shown.state.sensor))
        wish = _wish(shown)
        if wish is None or self._root != root_of(self._page.state.drive):
            self._clear()
        if wish is None:
            return
        self._show_place(wish)
        if self._wish is None or self._wish.key != wish.key:
            self._wish = wish
            if self.text.content == "":
                self.text.content = "Casting."
            self._latest.submit(lambda: self._run(wish))

    def close(self) -> None:
        """Draw nothing any more: the browser is gone."""
        self._wish = None
        self._latest.cancel()

    def _show_place(self, wish: _Wish) -> None:
        place = wish.placement
        widgets: tuple[tuple[Any, tuple[float, ...]], ...] = (
            (self.position, place.xyz_m),
            (self.angles, (place.yaw_deg, place.pitch_deg)),
        )
        for handle, values in widgets:
            rounded = tuple(round(value, 3) for value in values)
            if tuple(handle.value) != rounded:
                self._written[handle.label] = rounded
                handle.value = rounded
        if "gizmo" not in self._nodes:
            gizmo = self._page.scene.add_transform_controls(f"{self._root}/lab/gizmo", scale=2.5, line_width=4.0)
            gizmo.on_update(self._drag)
            self._nodes["gizmo"] = gizmo
        if self._dragged != place:
            # Under the mouse the gizmo is where it is.
            place_frame(self._nodes["gizmo"], wish.review_from_lidar)
        self._dragged = None

    def _drag(self, event: Any) -> None:
        wish = self._wish
        if wish is None:
            return
        review_from_lidar = np.eye(4)
        review_from_lidar[:3, :3] = SO3(np.array(event.target.wxyz)).as_matrix()
        review_from_lidar[:3, 3] = event.target.position
        local = invert(wish.review_from_body) @ review_from_lidar
        yaw, pitch, _ = pose_angles(local)
        x, y, z = local[:3, 3].tolist()
        # A sensor has no roll here: at the end the gizmo is set upright.
        self._place((x, y, z), (math.degrees(float(yaw)), math.degrees(float(pitch))), event.phase != "end")

    def _take(self, event: Any) -> None:
        # Setting a widget fires this too: what was written here is not the user's.
        if event.client_id is None and tuple(event.target.value) == self._written.get(event.target.label):
            return
        self._place(self.position.value, self.angles.value, False)

    def _place(self, xyz: tuple[float, ...], angles: tuple[float, ...], dragged: bool) -> None:
        numbers = tuple(round(float(value), 3) for value in (*xyz, *angles))
        if not all(map(math.isfinite, numbers)):
            return
        self._dragged = _placement(numbers) if dragged else None
        self._page.update(placement=numbers)

    def _run(self, wish: _Wish) -> None:
        """Cast and draw a sweep; runs in the thread of the lab."""
        try:
            self._draw(wish, self._made(wish))
        except UserError as error:
            self._tell(wish, str(error))
        except Exception as error:
            log.exception("the sensor cannot be cast")
            self._tell(wish, f"{type(error).__name__}: {error}")

    def _made(self, wish: _Wish) -> Cast:
        # Ray casting takes half a second to import, and few pages cast.
        from dsrc.review.labs.casting import open_world

        source = self._page.model.sources[wish.drive]
        if source.folder is None:
            raise DataError(complaint(source.name, "world", "a recorded drive", f"a source of kind {source.kind}"))
        carrier: int | NDArray[np.float64]
        if wish.carrier is None:
            carrier = wish.review_from_body.copy()
            carrier[:3, 3] += self._page.model.origin(wish.drive)
        else:
            carrier = wish.carrier
        return open_world(source.folder).cast(wish.index, wish.time_s, wish.spec, wish.placement, carrier)

    def _tell(self, wish: _Wish, text: str) -> None:
        if self._wish is not wish:
            return
        self.cast, self.text.content = None, quoted(text)
        if "cloud" in self._nodes:
            self._nodes["cloud"].visible = False

    def _draw(self, wish: _Wish, made: Cast) -> None:
        if self._wish is not wish:
            return
        points = made.sweep[subsample(made.sweep, wish.max_points)].points
        lidar = f"{self._root}/lab/lidar"
        if "lidar" not in self._nodes:
            self._nodes["lidar"] = self._page.scene.add_frame(lidar, show_axes=False)
            self._nodes["cloud"] = self._page.scene.add_point_cloud(
                f"{lidar}/points", points, np.array(SENSOR, np.uint8), point_shape="circle", point_shading="flat"
            )
        place_frame(self._nodes["lidar"], wish.review_from_lidar)
        cloud = self._nodes["cloud"]
        cloud.points, cloud.point_size = points, 1.3 * self._page.state.point_size_m
        cloud.visible = len(points) > 0
        self.cast, self.text.content = made, cast_report(wish.spec, made)

    def _clear(self) -> None:
        self._wish, self.cast, self._root = None, None, root_of(self._page.state.drive)
        self._latest.cancel()
        for name in ("cloud", "lidar", "gizmo"):
            if name in self._nodes:
                self._nodes.pop(name).remove()
        if self.text.content:
            self.text.content = ""


def cast_report(spec: LidarSpec, made: Cast) -> str:
    """Markdown of a cast sweep: points, rays and their rates."""
    cast, fired = made.rays / max(made.seconds, 1e-6), made.rays * spec.rate_hz
    return (
        f"**{thousands(len(made.sweep))} points** of {thousands(made.rays)} rays, cast in {1e3 * made.seconds:.0f} ms: "
        f"{cast / 1e6:.2f} M rays/s. The sensor fires {fired / 1e6:.2f} M rays/s."
    )


def _placement(numbers: tuple[float, ...]) -> Placement:
    x, y, z, yaw, pitch = numbers
    return Placement((x, y, z), yaw, pitch)


def _wish(shown: Shown) -> _Wish | None:
    """Sweep that what is shown asks for; None for none."""
    state, view = shown.state, shown.view
    if view is None or not state.sensor or view.drive != shown.model.names[state.drive]:
        return None
    spec = get_lidar(state.sensor)
    agents = {str(agent.agent_id): agent for agent in view.agents}
    agent = None if state.carrier == "pole" else agents.get(state.carrier, view.ego)
    heights = () if agent is None else view.truth.size[view.truth.object_id == agent.agent_id, 2]
    place = _placement(state.placement) if state.placement else usual_place(spec, agent, max(heights, default=0.0))
    body = np.eye(4) if agent is None else agent.review_from_body
    carrier = agent.agent_id if agent is not None and agent.kind == "vehicle" else None
    key = (state.drive, view.index, state.sensor, carrier, place, body.tobytes(), state.max_points)
    return _Wish(key, state.drive, view.index, view.time_s, spec, place, carrier, body, state.max_points)
