"""Panels of the live page: controls that change the state."""

from collections.abc import Callable
from functools import partial
from typing import Any

from dsrc.review.page.commands import commands
from dsrc.review.page.protocol import Page
from dsrc.review.state import COLOR_BY, IOU_THRESHOLDS, SHOWN_LAYERS, Camera, ReviewState
from dsrc.review.texts import frame_report, keys_table, legend, object_report
from dsrc.review.view import FrameView
from sensors.corruptions import CLEAN, CORRUPTIONS, FAMILIES
from sim.boxes import CLASSES

SPEEDS = {"0.25×": 0.25, "0.5×": 0.5, "1×": 1.0, "2×": 2.0, "4×": 4.0}

_NOBODY = "none"

CAMERAS: dict[str, Camera] = {"Chase": "chase", "BEV": "bev", "Free": "free"}


class Panels:
    """Controls of one page. A control calls methods of `Page` and draws nothing itself."""

    def __init__(self, app: Page) -> None:
        """Build the controls in the page of `app`."""
        self.app = app
        self.gui = app.server.gui
        # Setting a control fires its callback too: values written here are not the user's.
        self._written: dict[int, Any] = {}
        self._agents: tuple[int, ...] = ()
        self.agent_boxes: dict[int, Any] = {}
        self._titles: dict[str, int] = {}
        self._objects: dict[str, int] = {}
        self.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=(56, 150, 255), control_width="medium"
        )
        self.notice = self.gui.add_markdown("", visible=False)
        self._timeline()
        self.report = self.gui.add_markdown("")
        self._object()
        self._conditions()
        self._agent_folder = self.gui.add_folder("Agents and colours")
        with self._agent_folder:
            self.legend = self.gui.add_html("")
        self._look()
        self._keys()

    def show(self, view: FrameView, state: ReviewState) -> None:
        """Set the controls to the drawn state."""
        self.notice.visible = False
        last = max(self.app.model.frame_count(state.drive) - 1, 1)
        if self.frame.max != last:
            self.frame.max = last
        controls = (
            (self.frame, state.frame),
            (self.corruption, state.corruption),
            (self.severity, state.severity),
            (self.family, state.family),
            (self.threshold, state.threshold),
            (self.color_by, state.color_by),
        )
        for handle, value in controls:
            self._write(handle, value)
        self.severity.disabled = self.family.disabled = state.corruption == CLEAN
        self.report.content = frame_report(view)
        self._list_objects(view, state.object_id)
        self.object_report.content = object_report(view.details)
        self.legend.content = legend(view)
        self._list_agents(view)
        self._write(self.ego, view.ego.title)
        for agent in view.agents:
            self._write(self.agent_boxes[agent.agent_id], agent.visible)

    def show_error(self, text: str) -> None:
        """Show an error above the controls."""
        self.notice.content = f"**Error:** {text}"
        self.notice.visible = True

    def show_playing(self, playing: bool) -> None:
        """Label the button with its next action."""
        self.play.label = "Pause" if playing else "Play"

    @property
    def selected_speed(self) -> float:
        """Selected speed, in multiples of real time."""
        return SPEEDS[self.speed.value]

    def _write(self, handle: Any, value: Any) -> None:
        if handle.value != value:
            self._written[id(handle)] = value
            handle.value = value

    def _on_change(self, handle: Any, take: Callable[[Any], None]) -> None:
        """Call `take` with values set by a user or another program."""

        @handle.on_update
        def _(event: Any) -> None:
            value = event.target.value
            if event.client_id is None and self._written.get(id(handle), self) == value:
                return
            self._written.pop(id(handle), None)
            take(value)

    def _timeline(self) -> None:
        app, model = self.app, self.app.model
        # Two drives of one name in different folders need different entries.
        names = [name if model.names.count(name) == 1 else f"{i}: {name}" for i, name in enumerate(model.names)]
        self.drive = self.gui.add_dropdown(
            "Drive", tuple(names), initial_value=names[app.state.drive], visible=len(names) > 1
        )
        self._on_change(self.drive, lambda name: app.update(drive=names.index(name)))
        last = max(model.frame_count(app.state.drive) - 1, 1)
        self.frame = self.gui.add_slider("Frame", 0, last, 1, min(app.state.frame, last))
        self._on_change(self.frame, lambda row: app.update(frame=min(row, model.frame_count(app.state.drive) - 1)))
        self.steps = self.gui.add_button_group("Step", ("−10", "−1", "+1", "+10"))
        self.steps.on_click(lambda event: app.step(int(event.target.value.replace("−", "-"))))
        self.play = self.gui.add_button("Play", hint="Space")
        self.play.on_click(lambda _: app.toggle_play())
        self.speed = self.gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1×")
        self._on_change(self.speed, lambda name: app.play(SPEEDS[name]) if app.playing else None)
        self.camera = self.gui.add_button_group("Camera", tuple(CAMERAS))
        self.camera.on_click(lambda event: app.set_camera(CAMERAS[event.target.value]))

    def _conditions(self) -> None:
        app, state = self.app, self.app.state
        with self.gui.add_folder("Conditions"):
            kinds = (CLEAN, *CORRUPTIONS)
            self.corruption = self.gui.add_dropdown("Corruption", kinds, initial_value=state.corruption)
            self._on_change(self.corruption, lambda kind: app.update(corruption=kind))
            self.severity = self.gui.add_slider("Severity", 1, 5, 1, state.severity)
            self._on_change(self.severity, lambda level: app.update(severity=level))
            self.family = self.gui.add_dropdown("Settings", FAMILIES, initial_value=state.family)
            self._on_change(self.family, lambda family: app.update(family=family))
        with self.gui.add_folder("Detections", visible=app.model.has_detector):
            self.threshold = self.gui.add_slider("Score ≥", 0.0, 1.0, 0.01, state.threshold)
            self._on_change(self.threshold, lambda score: app.update(threshold=score))
            self.iou = self.gui.add_dropdown(
                "IoU ≥", tuple(str(iou) for iou in IOU_THRESHOLDS), initial_value=str(state.iou)
            )
            self._on_change(self.iou, lambda iou: app.update(iou=float(iou)))
            self.ego = self.gui.add_dropdown("Ego", ("–",))
            self._on_change(self.ego, self._choose_ego)
            self.cooperative = self.gui.add_checkbox("Cooperative", state.cooperative)
            self._on_change(self.cooperative, lambda on: app.update(cooperative=on))

    def _object(self) -> None:
        with self.gui.add_folder("Object", expand_by_default=False):
            self.object = self.gui.add_dropdown("Object", (_NOBODY,))
            self._on_change(self.object, lambda title: self.app.update(object_id=self._objects.get(title)))
            self.object_report = self.gui.add_markdown("")

    def _list_objects(self, view: FrameView, selected: int | None) -> None:
        """List the objects of the frame, and the selected one even while absent."""
        truth = view.truth
        names = [CLASSES[label] for label in truth.label.tolist()]
        objects = {f"{name} {number}": number for name, number in zip(names, truth.object_id.tolist(), strict=True)}
        if selected is not None and selected not in objects.values():
            objects[f"object {selected}"] = selected
        title = next((title for title, number in objects.items() if number == selected), _NOBODY)
        if objects != self._objects:
            self._objects = objects
            if self.object.value not in objects:
                # New options set the value: not the user's.
                self._written[id(self.object)] = _NOBODY
            self.object.options = (_NOBODY, *objects)
        self._write(self.object, title)

    def _look(self) -> None:
        app, state = self.app, self.app.state
        with self.gui.add_folder("Look", expand_by_default=False):
            self.color_by = self.gui.add_dropdown("Points by", COLOR_BY, initial_value=state.color_by)
            self._on_change(self.color_by, lambda name: app.update(color_by=name))
            self.point_size = self.gui.add_slider("Point size", 0.02, 0.5, 0.01, state.point_size_m)
            self._on_change(self.point_size, lambda size: app.update(point_size_m=size))
            self.max_points = self.gui.add_slider("Points/agent", 2000, 120_000, 1000, state.max_points)
            self._on_change(self.max_points, lambda points: app.update(max_points=points))
            self.layers = {
                name: self.gui.add_checkbox(name.capitalize(), name not in state.layers_off) for name in SHOWN_LAYERS
            }
        for handle in self.layers.values():
            self._on_change(handle, lambda _: app.update(layers_off=self._layers_off()))

    def _layers_off(self) -> frozenset[str]:
        return frozenset(name for name, handle in self.layers.items() if not handle.value)

    def _keys(self) -> None:
        listed = commands(self.app)
        for command in listed:
            modifier = "shift" if command.shift else None
            handle = self.gui.add_command(command.label, hotkey=command.key, modifier=modifier)  # type: ignore[arg-type]
            handle.on_trigger(_ignoring_event(command.run))
        with self.gui.add_folder("Keys", expand_by_default=False):
            self.gui.add_markdown(keys_table((command.label, command.key_text) for command in listed))

    def _list_agents(self, view: FrameView) -> None:
        """Rebuild the list of agents when they change."""
        agents = tuple(agent.agent_id for agent in view.agents)
        if agents == self._agents:
            return
        self._agents = agents
        for handle in self.agent_boxes.values():
            handle.remove()
        self.agent_boxes = {}
        self._titles = {agent.title: agent.agent_id for agent in view.agents}
        # New options set the value: not the user's.
        self._written[id(self.ego)] = view.agents[0].title
        self.ego.options = tuple(self._titles)
        with self._agent_folder:
            for agent in view.agents:
                handle = self.gui.add_checkbox(agent.title.capitalize(), agent.visible)
                self.agent_boxes[agent.agent_id] = handle
                self._on_change(handle, partial(self._show_agent, agent.agent_id))

    def _choose_ego(self, title: str) -> None:
        if title in self._titles:
            self.app.update(ego_id=self._titles[title])

    def _show_agent(self, agent_id: int, shown: bool) -> None:
        hidden = self.app.state.hidden
        self.app.update(hidden=hidden - {agent_id} if shown else hidden | {agent_id})


def _ignoring_event(run: Callable[[], None]) -> Callable[[Any], None]:
    return lambda _: run()
