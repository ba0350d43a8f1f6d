"""Command `dsrc view`: review drives in the browser or in one HTML page."""

import os
import sys

import msgspec

from dsrc.cli.progress import log_lines, made, progress
from dsrc.options.fields import File, Output
from dsrc.options.review import ServeOptions

_OF_SERVER = ("host", "port", "allow_origin")
_OF_CORRUPTION = ("severity", "family", "corrupted_agents")
_LEAVE_OUT = "leave out {}"
_ADD_CORRUPTION = "{} says how sensors are corrupted; add --corruption"


class View(ServeOptions, frozen=True, kw_only=True):
    """Review drives in the browser, or write one self-contained HTML page.

    Examples:
        dsrc view data/test --checkpoint detector.pt
        dsrc view results
        dsrc view data/test --out page.html

    Attributes:
        out: HTML page to write: of the link's view with card, plots and pictures of the errors, else one that plays the
            drive; default: serve the page.
        picture: PNG of the view with legend and card, drawn by Chromium; default: none.
        animation: GIF of the view, drawn by Chromium; default: none.
        link: address of a page, or its part after the question mark: what is written beside what the options say;
            default: nothing.
        size: width and height of a picture or animation, px.
        frames: frames of a page or an animation, from the one at the start.
        verbose: also say which engine runs the networks, and why.
    """

    out: File | None = None
    picture: File | None = None
    animation: File | None = None
    link: str = ""
    size: tuple[int, int] = (1280, 720)
    frames: int = 40
    verbose: bool = False
    output: Output = Output()

    def run(self) -> None:
        """Serve the page until interrupted, or write it and print its path."""
        self._check()
        if self.verbose:
            log_lines("dsrc.models.storage", on_terminals=True)
        if self.out is not None or self.picture is not None or self.animation is not None:
            self._write()
            return
        from dsrc.review.page.app import serve

        app = serve(self, announce=_announce)
        if app.busy:
            # A detector in a thread would end the process with an abort. Files are whole: each is renamed at once.
            os._exit(0)
        raise SystemExit(0)  # an interrupt is how it ends

    def _check(self) -> None:
        """Raise SettingsError for numbers out of their range, options that exclude each other or have no effect."""
        from sim.errors import SettingsError, complaint

        if not all(16 <= side <= 8192 for side in self.size):
            raise SettingsError(complaint("view", "size", "16 to 8192 px each", str(self.size)))
        if self.frames < 1:
            raise SettingsError(complaint("view", "frames", "at least 1", self.frames))
        for name, ending in (("picture", ".png"), ("animation", ".gif")):
            path: File | None = getattr(self, name)
            if path is not None and path.suffix.lower() != ending:
                raise SettingsError(complaint("view", name, f"a file that ends with {ending}", str(path)))
        if not 1 <= self.severity <= 5:
            raise SettingsError(complaint("view", "severity", "1 to 5", self.severity))
        self._refuse(self._unused())

    def _unused(self) -> dict[str, str]:
        """Options that do nothing here, by name: why, and what to do."""
        draws = self.picture is not None or self.animation is not None
        unused: dict[str, str] = {}
        if draws or self.out is not None:
            unused |= dict.fromkeys(_OF_SERVER, f"it is written without a server; {_LEAVE_OUT}")
        else:
            unused["link"] = "{} says what is written; add --out, --picture or --animation"
        if self.checkpoint is None:
            unused["height"] = "{} is of a detector's clouds; add --checkpoint"
        if not draws:
            unused["size"] = "{} is of pictures; add --picture or --animation"
        if self.out is None and self.animation is None:
            unused["frames"] = "{} is of pages and animations; add --out or --animation"
        return unused

    def _refuse(self, unused: dict[str, str]) -> None:
        """Raise SettingsError for the first of some options that is given.

        Args:
            unused: by name why the option does nothing, and what to do; {} stands for the option.
        """
        from sim.errors import SettingsError, option

        defaults = {field.name: field.default for field in msgspec.structs.fields(type(self))}
        for name, why in unused.items():
            if getattr(self, name) != defaults[name]:
                raise SettingsError(f"view: {why.format(option(name))}")

    def _write(self) -> None:
        """Write page, picture and animation of the view of options and link, and print their paths."""
        from dsrc.review.model import open_model
        from dsrc.review.page.app import first_state
        from dsrc.review.page.link import linked_views
        from dsrc.review.page.output.export import export_pictures, picture, write_animation, write_page, write_picture
        from sensors.corruptions import Condition
        from sim.files import check_apart, check_output

        Condition.of(self.corruption, self.severity, self.family, self.corrupted_agents).checked()
        for path, kind in ((self.out, "web page"), (self.picture, "picture"), (self.animation, "animation")):
            if path is not None:
                check_apart(path, self.data)
                check_output(path, kind)
        model = open_model(self.data, self.checkpoint, self.drives, self.engine, self.height)
        start = first_state(model, self)
        state, _ = linked_views(model, self.link, start)[0]
        asked = ("frame", "corruption", *_OF_CORRUPTION)
        others = [name for name in asked if getattr(state, name) != getattr(self, name)]
        self._refuse(dict.fromkeys(others, f"the link says otherwise; {_LEAVE_OUT}"))
        if state.corruption == "clean":
            self._refuse(dict.fromkeys(_OF_CORRUPTION, _ADD_CORRUPTION))
        if self.out is not None:
            with progress(f"write {self.out}") as report:
                write_page(model, self.link, self.out, self.frames, start)
                report(1, 1)
            made(self.out, "a page for any browser")
        if self.picture is not None:
            sys.stdout.write(f"{write_picture(picture(model, self.link, self.size, start), self.picture)}\n")
        if self.animation is not None:
            rows = range(state.frame, min(state.frame + self.frames, len(model.sources[state.drive])))
            with progress(f"draw {self.animation}") as report:
                images = []
                for image in export_pictures(model, self.link, self.size, rows, start):
                    images.append(image)
                    report(len(images), len(rows))
            pause_s = model.interval_s(state.drive) / state.speed
            sys.stdout.write(f"{write_animation(images, self.animation, pause_s)}\n")


def _announce(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
