"""Command `dsrc view`: review drives in the browser or in one HTML page."""

import sys
from typing import Annotated

import msgspec

from dsrc.cli.options import CORRUPTIONS, Data, File, Severity, choice
from dsrc.cli.progress import progress


class View(msgspec.Struct, frozen=True, kw_only=True):
    """Review drives in the browser, or write one self-contained HTML page.

    Attributes:
        data: a drive, or a folder of drives.
        checkpoint: detector file whose detections are drawn and matched; default: no detections.
        corruption: corruption at the start.
        port: port of the page on 127.0.0.1; default: a free one.
        out: HTML page to write; default: serve the page.
        picture: PNG of the written page, drawn by Chromium; default: none.
        frames: frames of a written page, from the first.
    """

    data: Data
    checkpoint: File | None = None
    corruption: Annotated[str, choice(("clean", *CORRUPTIONS))] = "clean"
    level: Severity = Severity()
    port: int | None = None
    out: File | None = None
    picture: File | None = None
    frames: int = 40

    def run(self) -> None:
        """Serve the page until interrupted, or write it and print its path."""
        corruption = {"corruption": self.corruption, **msgspec.structs.asdict(self.level)}
        if self.out is None:
            if self.picture is not None:
                from sim.errors import SettingsError, complaint

                raise SettingsError(complaint("view", "picture", "a page to draw, --out", "nothing"))
            from dsrc.review.page.app import serve

            serve(self.data, self.checkpoint, port=self.port, announce=_announce, **corruption)
            return
        from dsrc.review.page.export import export_html

        with progress(f"write {self.out}") as report:
            page = export_html(self.data, self.out, checkpoint=self.checkpoint, frames=self.frames, **corruption)
            report(1, 1)
        sys.stdout.write(f"{page}\n")
        if self.picture is not None:
            from dsrc.review.page.screenshot import screenshot

            sys.stdout.write(f"{screenshot(page, self.picture)}\n")


def _announce(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
