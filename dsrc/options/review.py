"""Options of `dsrc view`: live pages and written ones."""

from typing import Annotated, Literal

from tyro.conf import arg

from dsrc.options.detection import AutoEngine, Checkpoint, Height
from dsrc.options.fields import CORRUPTIONS, Corrupted, Data, File, Folder, choice

ColorBy = Literal[
    "verdict", "agent", "height", "intensity", "ring", "fate", "range", "time", "return", "incidence", "object"
]
"""What colour means: right and wrong boxes, who saw a point, or a quantity of the points."""


class Review(Corrupted, frozen=True, kw_only=True):
    """Options of any review page.

    Attributes:
        checkpoint: detector whose detections are drawn and matched, see dsrc evaluate; default: no detections.
        corruption: corruption at the start.
        drives: folder of the drives of results or of a training, where they were moved; default: where they were.
        height: ground under the clouds that the detector gets, see dsrc detect.
        engine: execution of the network, see dsrc drive.
    """

    checkpoint: Checkpoint | None = None
    corruption: Annotated[str, choice(("clean", *CORRUPTIONS))] = "clean"
    drives: Folder | None = None
    height: Height = "recorded"
    engine: AutoEngine = "auto"


class ServeOptions(Review, frozen=True):
    """Options of a live page.

    Attributes:
        data: a drive, a folder of drives, results of an evaluation, shares, a training, or episodes.
        frame: frame at the start, its row in the first drive.
        host: address to listen on; default: this machine alone.
        port: port of the page; default: a free one.
        allow_origin: hosts under which a proxy or a tunnel shows the page, such as hub.example.org of JupyterHub; the
            page still listens on `host` alone; default: none.
    """

    data: Data
    frame: int = 0
    host: str = "127.0.0.1"
    port: int | None = None
    allow_origin: Annotated[tuple[str, ...], arg(metavar="HOST [...]")] = ()


class PageOptions(Review, frozen=True):
    """Options of a written page.

    Attributes:
        data: a drive, a folder of drives, or anything else that a live page shows.
        out: HTML page to write.
        frames: number of frames from the first, or a slice of the drive's frames.
        frame: frame at the start, its row in the first drive.
        link: address of a live page, or its part after the question mark: what is shown beside that; the page then
            stands at its first frame, with card, plots over time and pictures of the errors. Default: it plays the
            drive.
        max_points: points per frame, all agents together; None for a page of at most 8 MB.
    """

    data: Data
    out: File
    frames: slice | int = 40
    frame: int = 0
    link: str = ""
    max_points: int | None = None
