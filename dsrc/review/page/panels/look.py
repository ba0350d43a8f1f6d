"""Look: speed, camera, points, layers and theme."""

from dsrc.review.page.controls import Choice, Control, Slider, Switch, named, same
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel
from dsrc.review.state import COLOR_BY, EPISODE_LAYERS, SHOWN_LAYERS

_SPEEDS = {f"{speed:g}×": speed for speed in (0.25, 0.5, 1.0, 2.0, 4.0)}


def _of_episode(shown: Shown) -> bool:
    return shown.view is not None and shown.view.moment is not None


class LookPanel(Panel):
    """Closed folder."""

    title = "Look"
    table = (
        Control("speed", Choice(named(_SPEEDS)), "Speed", link="speed"),
        Control(
            "camera", Choice(named({"Free": "free", "Chase": "chase", "Bird's eye": "bev"})), "Camera", link="camera"
        ),
        Control("follow", Choice(named({"Ego": "ego", "Selected": "selected"})), "Follow", link="follow"),
        Control("rings", Switch(), "Range rings", link="rings"),
        Control("cut", Switch(), "Cut walls", link="cut"),
        Control("color_by", Choice(same(*COLOR_BY)), "Colour by", link="color", key="U"),
        Control(
            "boxes_by",
            Choice(named({"Who helped": "shares", "Verdict": "verdict"})),
            "Boxes by",
            link="boxes",
            shown=lambda shown: shown.model.has_shares(shown.state.drive),
        ),
        Control("point_size_m", Slider(0.02, 0.5, 0.01), "Point size", link="size"),
        Control("max_points", Slider(2000, 120_000, 1000), "Points/agent", link="points"),
        Control("theme", Choice(named({"Dark": "dark", "Light": "light"})), "Theme", link="theme", key="T"),
        *(
            Control(
                "layers_off",
                Switch(layer),
                layer.capitalize(),
                link="off",
                shown=_of_episode if layer in EPISODE_LAYERS else lambda _: True,
            )
            for layer in SHOWN_LAYERS
        ),
    )
