"""The left turn of the README: the same encounter driven alone and with helpers, side by side in daylight.

Usage:
    python -m studies.pictures.left_turn --out docs/pictures/closed_loop/left_turn.gif
    python -m studies.pictures.left_turn --out /tmp/queue.gif --scenario ima_queue --seed 4
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import matplotlib as mpl
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import dsrc
from dsrc.closed_loop.types import Tick
from dsrc.review.page.output.export import write_animation
from sim.encounters import encounter_of
from sim.traffic.script import FIRST_ID
from sim.world.build import build_world
from studies.pictures.places import Stage, everything, picture
from studies.pictures.scenarios import COLORS, mark, seen_at

SIZE = (440, 340)
HEAD = 46
"""Pixels above each half that say whose eyes these are, and what they see."""

GAP = 8
FIELD_DEG = 62.0
HEIGHT_M = 37.0
STEP = 1
"""Steps of the traffic from picture to picture."""

INTERVAL_S = 0.12
BEFORE_S, AFTER_S = 3.2, 3.4
"""Time shown around the contact, s."""

EYES = {"ego": "alone: its own LiDAR", "team": "with helpers: their LiDAR, too"}
INK, CALM, ALARM = (28, 36, 46), (24, 128, 66), (206, 26, 26)
NEAR_M = 2.5
"""Distance at which a track is of the hidden car, m."""


@dataclass(frozen=True)
class Camera:
    """Camera of both halves: behind the ego, above the crash; field of view in degrees."""

    eye: NDArray[np.float64]
    target: NDArray[np.float64]

    @classmethod
    def over(cls, log: dsrc.EpisodeLog, moment_s: float) -> Self:
        """Return the camera over the place of an instant."""
        actors = at(log, moment_s).actors
        first = log.ticks[0].ego.box
        center = actors.boxes.center[[actors.row(FIRST_ID), actors.row(FIRST_ID + 1)]].mean(axis=0) * [1.0, 1.0, 0.0]
        ahead = np.array([np.cos(first.yaw[0]), np.sin(first.yaw[0]), 0.0])
        return cls(center - 0.45 * HEIGHT_M * ahead + [0.0, 0.0, HEIGHT_M], center - 1.0 * ahead)


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="the GIF")
    parser.add_argument("--scenario", default="lta_truck", help="an encounter")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--logs", type=Path, nargs=2, help="logs of both drives, alone first; driven when left out")
    options = parser.parse_args()
    if options.logs:
        logs = [dsrc.EpisodeLog.load(path) for path in options.logs]
    else:
        logs = [drive(options.scenario, name, options.seed) for name in EYES]
    write_animation(pictures(logs), options.out, INTERVAL_S)
    print(f"{options.out}  {options.out.stat().st_size / 1024:.0f} kB")


def drive(scenario: str, perception: str, seed: int) -> dsrc.EpisodeLog:
    """Return the log of one drive, five percepts a second."""
    settings = dsrc.LoopSettings(duration_s=14.0, detect_every_s=0.2)
    loop = dsrc.ClosedLoop(
        scenario, dsrc.open_perception(perception, interval_s=0.2, engine="fused"), settings=settings
    )
    loop.run(seed)
    return loop.log(perception=perception)


def at(log: dsrc.EpisodeLog, time_s: float) -> Tick:
    """Return the first step from a time on, the last one where there is none."""
    return next((tick for tick in log.ticks if tick.actors.time_s >= time_s - 1e-6), log.ticks[-1])


def pictures(logs: list[dsrc.EpisodeLog]) -> Iterator[NDArray[np.uint8]]:
    """Yield both drives side by side around the first contact of either; a drive that has ended stands still."""
    settings = logs[0].settings
    moment_s = next(log.contact.time_s for log in logs if log.contact)
    world, camera = build_world(settings.scenario, settings.seed), Camera.over(logs[0], moment_s)
    half = {index: np.zeros(0) for index in range(len(logs))}
    for time_s in np.arange(moment_s - BEFORE_S, moment_s + AFTER_S, STEP * logs[0].actors.step_s):
        for index, log in enumerate(logs):
            if log.ticks[-1].actors.time_s > time_s - STEP * log.actors.step_s or not half[index].size:
                half[index] = drawn(log, float(time_s), world, camera)
        yield np.hstack([half[0], np.full((len(half[0]), GAP, 3), 255, np.uint8), half[1]])


def drawn(log: dsrc.EpisodeLog, time_s: float, world: trimesh.Trimesh, camera: Camera) -> NDArray[np.uint8]:
    """Return one half of a picture: a drive from above, and what the ego knows of the hidden car."""
    tick = at(log, time_s)
    view = (camera.eye, camera.target, FIELD_DEG)
    scene = Image.fromarray(picture(Stage.of(everything(world, tick.actors, -1)), *view, SIZE))
    layout = encounter_of(log.settings.scenario, log.settings.seed).layout
    mark(scene, view, tick.actors, {one.name: one.roles for one in layout.actors}, tuple(COLORS), SIZE)
    whole = Image.new("RGB", (SIZE[0], SIZE[1] + HEAD), (255, 255, 255))
    whole.paste(scene, (0, HEAD))
    pen = ImageDraw.Draw(whole)
    pen.text((4, 1), EYES[log.settings.perception], INK, font(17))
    text, colour = state(log, tick)
    pen.text((4, 22), text, colour, font(17))
    if log.contact and tick.actors.time_s >= log.contact.time_s - 1e-6:
        struck(pen, tick, view)
    return np.asarray(whole)


def state(log: dsrc.EpisodeLog, tick: Tick) -> tuple[str, tuple[int, int, int]]:
    """Return what a half says of an instant, and in which colour."""
    if log.contact and tick.actors.time_s >= log.contact.time_s - 1e-6:
        return f"crash at {log.contact.closing_mps:.0f} m/s", ALARM
    speed = f"{tick.ego.speed_mps:.0f} m/s"
    if not any(known(one) for one in log.ticks[: log.ticks.index(tick) + 1]):
        return f"{speed}, has not seen the red car", INK
    return f"{speed}, has seen the red car", CALM


def known(tick: Tick) -> bool:
    """Return whether the ego has a track of the hidden car."""
    hidden = tick.actors.boxes.center[tick.actors.row(FIRST_ID + 1), :2]
    return bool((np.hypot(*(tick.tracks.boxes.center[:, :2] - hidden).T) < NEAR_M).any())


def struck(pen: ImageDraw.ImageDraw, tick: Tick, view: tuple) -> None:
    """Draw a star where the ego and the hidden car touch."""
    both = [tick.actors.row(FIRST_ID), tick.actors.row(FIRST_ID + 1)]
    ego, other = (tick.actors.boxes[row : row + 1] for row in both)
    corners = np.concatenate([ego.corners()[0], other.corners()[0]])
    # The corner that is nearest to the other body.
    gaps = np.concatenate(
        [np.hypot(*(one[:, :2] - two.center[0, :2]).T) for one, two in ((corners[:8], other), (corners[8:], ego))]
    )
    (place,), _ = seen_at(view, corners[[int(np.argmin(gaps))]], SIZE)
    middle = place + np.array([0.0, HEAD])
    turns = np.arange(16) * np.pi / 8.0
    reach = np.where(np.arange(16) % 2, 11.0, 25.0)
    star = middle + np.column_stack([np.cos(turns), np.sin(turns)]) * reach[:, None]
    pen.polygon([tuple(point) for point in star], fill=(255, 214, 10), outline=ALARM, width=3)


def font(size: int) -> ImageFont.FreeTypeFont:
    """Return the bold font that matplotlib brings."""
    return ImageFont.truetype(Path(mpl.get_data_path()) / "fonts/ttf/DejaVuSans-Bold.ttf", size)


if __name__ == "__main__":
    main()
