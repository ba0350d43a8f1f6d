"""Pictures of the review page for its documentation, made in a real Chromium.

Usage:
    python -m studies.pictures.review data/test/berlin_301 --checkpoint dsrc/checkpoints/small-dsrc.pt

Pictures of results, of episodes and of who helped are added with `--evaluation FOLDER` of `dsrc evaluate` on the drive,
`--campaign FOLDER` of `dsrc drive`, and `--shares FOLDER` of `dsrc shares` on the drive. `make -f studies/Makefile
pictures` makes these folders and all pictures.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dsrc.review.model import ReviewModel, open_model
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.cells import cells_of, compare_address
from dsrc.review.page.commands import go_to_error
from dsrc.review.page.link import write_link
from dsrc.review.page.output.export import export_pictures, write_animation
from dsrc.review.page.output.screenshot import PATIENCE_S, BrowserPage, open_page
from dsrc.review.page.server import start_server
from dsrc.review.page.session import Session
from dsrc.review.state import ReviewState
from sim.files import signed_picture, write_file

SIZE = (1500, 850)
VIEW = "frame=10&camera=bev&off=labels"
SNOW = "corruption=snow&severity=3"
NEAR = "camera=chase&off=labels&view=-25,-6,15,6,2,0"
"""View of the animation: nearer than the camera that chases the ego by itself."""
SHARED = "/?fixedDpr=1&frame=46&camera=bev&off=labels"
SMOOTH = (1280, 640), (800, 400)
"""Sizes of the animation as it is drawn and as it is written, px: lines and points get smooth edges."""
HIDE_NOTICES = """
for(const page of [document,...[...document.querySelectorAll('iframe')].map(cell=>cell.contentDocument)])
 page.head.insertAdjacentHTML('beforeend','<style>.mantine-Notifications-root{display:none!important}</style>')
"""
SCENE_IN_PLACE = "for(let e=document.querySelector('canvas');e;e=e.parentElement)e.scrollTop=0"
"""Scrolling a panel moves the scene behind it, too."""


def picture_of_page(
    model: ReviewModel,
    address: str,
    out: Path,
    prepare: Callable[[Session, BrowserPage], None] = lambda *_: None,
    cells: int = 1,
    size: tuple[int, int] = SIZE,
) -> None:
    """Write a picture of a page with its panels.

    Args:
        model: of the page.
        address: path and query.
        out: PNG.
        prepare: called with the first session and the page before the picture is taken.
        cells: sessions of the page.
        size: width and height of the page, px.
    """
    app = ReviewApp(model, start_server(), ReviewState(**model.opening(0)))
    try:
        with open_page(app.url + address, size) as page:
            sessions = app.wait_session(cells, PATIENCE_S)
            for session in sessions:
                session.wait_drawn(PATIENCE_S)
            page.evaluate(HIDE_NOTICES)
            time.sleep(3.0)
            prepare(sessions[0], page)
            for session in sessions:
                session.wait_drawn(PATIENCE_S)
            page.evaluate(SCENE_IN_PLACE)
            time.sleep(5.0)
            write_file(out, signed_picture(page.png()))
    finally:
        app.close()


def smooth_pictures(model: ReviewModel, rows: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures of an animation, drawn larger than they are."""
    drawn, written = SMOOTH
    for image in export_pictures(model, NEAR, drawn, rows):
        yield np.asarray(Image.fromarray(image).resize(written, Image.Resampling.LANCZOS))


def show_folder(title: str, folded: bool = False) -> Callable[[Session, BrowserPage], None]:
    """Scroll to a folder, opened."""
    folder = f"[...document.querySelectorAll('*')].filter(e=>e.textContent.trim()==='{title}').pop()"

    def show(_: Session, page: BrowserPage) -> None:
        page.wait_for(folder, PATIENCE_S)
        if folded:
            page.evaluate(f"{folder}.click()")
            time.sleep(1.0)
        page.evaluate(f"{folder}.scrollIntoView({{block:'start'}})")

    return show


def show_errors(session: Session, _: BrowserPage) -> None:
    """Detect in all frames and go to the worst false box."""
    session.detect_all()
    while session.detecting():
        time.sleep(0.5)
    go_to_error(session, 1, "false")
    time.sleep(2.0)


def show_sweeps(session: Session, _: BrowserPage) -> None:
    """Wait until the sweeps of an episode can be cast again, and its page has drawn them."""
    while not any(len(agent.points) for agent in session.wait_drawn(PATIENCE_S).agents):
        time.sleep(0.5)
    time.sleep(5.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path, help="drive to show")
    parser.add_argument("--checkpoint", type=Path, required=True, help="detector")
    parser.add_argument("--evaluation", type=Path, help="folder of dsrc evaluate on the drive")
    parser.add_argument("--campaign", type=Path, help="folder of dsrc drive, one encounter with several eyes")
    parser.add_argument("--shares", type=Path, help="folder of dsrc shares")
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/review"), help="folder of the pictures")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="pictures to make; default: all")
    parser.add_argument("--frames", type=int, default=10, help="frames of the animation")
    given = parser.parse_args()
    model, out = open_model(given.drive, given.checkpoint), given.out
    rows = range(20, min(20 + given.frames, len(model.sources[0])))
    foggy = f"{VIEW}&corruption=fog&severity=4"
    fog = "/?fixedDpr=1&frame=3&color=fate&corruption=fog&parameters=extinction:0.05"
    pole = "/?fixedDpr=1&frame=3&color=height&sensor=vlp-16&carrier=pole&placement=0,0,6,0,15"
    pictures: dict[str, Callable[[Path], object]] = {
        "errors.png": lambda path: picture_of_page(model, "/?fixedDpr=1&frame=3", path, show_errors),
        "cells.png": lambda path: picture_of_page(model, compare_address(VIEW, foggy), path, cells=2),
        "corruption_lab.png": lambda path: picture_of_page(model, fog, path, show_folder("Corruption lab", True)),
        "sensor_lab.png": lambda path: picture_of_page(model, pole, path, show_folder("Sensor lab", True)),
        "drive.gif": lambda path: write_animation(smooth_pictures(model, rows), path, 0.1),
    }
    if given.evaluation is not None:
        results = open_model(given.evaluation)
        pictures["overview.png"] = lambda path: picture_of_page(results, "/?fixedDpr=1", path)
        worst = f"/?fixedDpr=1&{SNOW}&gallery=1"
        pictures["gallery.png"] = lambda path: picture_of_page(results, worst, path, show_folder("Errors by cause"))
        pictures["narrow.png"] = lambda path: picture_of_page(results, f"/?fixedDpr=1&{SNOW}", path, size=(700, 850))
    if given.campaign is not None:
        episodes = open_model(given.campaign)
        opened = ReviewState(**episodes.opening(0))
        eyes = compare_address(*(write_link(episodes, one) for one in cells_of(episodes, opened)[:2]))
        pictures["episode.png"] = lambda path: picture_of_page(episodes, "/?fixedDpr=1", path, show_sweeps)
        pictures["eyes.png"] = lambda path: picture_of_page(episodes, eyes, path, show_sweeps, 2)
    if given.shares is not None:
        pictures["shares.png"] = lambda path: picture_of_page(open_model(given.shares), SHARED, path)
    for name in given.only or pictures:
        pictures[name](out / name)
        print(out / name)


if __name__ == "__main__":
    main()
