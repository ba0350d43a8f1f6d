"""Command `dsrc view`: review drives in the browser or in one HTML page."""

import sys
import tempfile
from pathlib import Path

from dsrc.cli.progress import progress
from dsrc.options.fields import File, Output
from dsrc.options.review import Review, ServeOptions


class View(ServeOptions, frozen=True, kw_only=True):
    """Review drives in the browser, or write one self-contained HTML page.

    Attributes:
        out: HTML page to write; default: serve the page.
        picture: PNG of the written page, drawn by Chromium; default: none.
        frames: frames of a written page, from the first.
    """

    out: File | None = None
    picture: File | None = None
    frames: int = 40
    output: Output = Output()

    def run(self) -> None:
        """Serve the page until interrupted, or write it and print its path."""
        if self.out is None:
            if self.picture is not None:
                from sim.errors import SettingsError, complaint

                raise SettingsError(complaint("view", "picture", "a page to draw, --out", "nothing"))
            from dsrc.review.page.app import serve

            serve(self, announce=_announce)
            raise SystemExit(0)  # an interrupt is how it ends
        from dsrc.review.page.export import export_html
        from sim.files import check_apart, check_output

        for path, kind in ((self.out, "web page"), (self.picture, "picture")):
            if path is not None:
                check_apart(path, self.data)
                check_output(path, kind)
        shown = {name: getattr(self, name) for name in Review.__struct_fields__}
        with progress(f"write {self.out}") as report:
            page = export_html(self.data, self.out, self.frames, **shown)
            report(1, 1)
        sys.stdout.write(f"{page}\n")
        if self.picture is not None:
            sys.stdout.write(f"{draw(page, self.picture)}\n")


def draw(page: Path, out: Path) -> Path:
    """Write a PNG of a written page, with the note by which it is known as ours; raises as `screenshot`."""
    from dsrc.review.page.screenshot import screenshot
    from sim.files import signed_picture, write_file

    with tempfile.TemporaryDirectory() as folder:
        content = screenshot(page, Path(folder) / "page.png").read_bytes()
    write_file(out, signed_picture(content))
    return out


def _announce(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
