"""Pictures of the encounters at the moment of reveal, from above and from the ego's driver's seat.

Usage:
    python -m studies.pictures.scenarios --out docs/pictures/scenarios
    python -m studies.pictures.scenarios --out /tmp/pictures --only ima_building ped_dartout --seed 3
    python -m studies.pictures.scenarios --measure 20
    python -m studies.pictures.scenarios --safe 5
"""

import argparse
from collections import Counter
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from sensors.recording.encounter_check import Proof, find_encounter
from sensors.recording.safe_speed import safe_speed
from sim.boxes import Boxes
from sim.catalog.load import list_scenarios, load_scenario
from sim.encounters import ENCOUNTERS, encounter_of
from sim.geometry import wrap_angle
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.traffic.script import FIRST_ID, ScriptedTraffic
from sim.world.build import build_world
from studies.pictures.places import SIZE, Stage, everything, picture

COLORS = {"ego": (40, 120, 255), "conflict": (255, 40, 40), "helper": (250, 190, 20)}
EYE_M = 1.55
_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="folder of the pictures")
    parser.add_argument("--only", nargs="+", metavar="NAME", default=encounters(), help="encounters; all when left out")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--measure", type=int, metavar="SEEDS", help="print what the proofs of so many seeds found")
    parser.add_argument("--safe", type=int, metavar="SEEDS", help="print the safe speeds of so many seeds")
    options = parser.parse_args()
    for name in options.only:
        scenario = load_scenario(name)
        if options.measure:
            print(measured(scenario, options.measure))
        if options.safe:
            print(safe(scenario, options.safe))
        if options.out:
            for path in draw(scenario, options.seed, options.out):
                print(f"{path}  {path.stat().st_size / 1024:.0f} kB")


def encounters() -> list[str]:
    """Return the shipped scenarios with an encounter: twelve on made roads, then those on maps."""
    mapped = [name for name in list_scenarios() if name not in ENCOUNTERS and load_scenario(name).conflict is not None]
    return [*ENCOUNTERS, *mapped]


def measured(scenario: Scenario, seeds: int) -> str:
    """Return a table row: used and rejected draws, times of first detection, first helper."""
    found = [find_encounter(scenario, seed) for seed in range(1, seeds + 1)]
    rejected = sum((Counter(one.rejected) for one in found), Counter())
    proofs = [one.proof for one in found]
    helpers = Counter(proof.helper for proof in proofs).most_common()
    cells = [
        scenario.name,
        f"{seeds} of {seeds + rejected.total()}",
        ", ".join(f"{count} {reason}" for reason, count in rejected.most_common()) or "-",
        _spread([proof.critical_ttc_s for proof in proofs]),
        _spread([proof.ego_ttc_s for proof in proofs]),
        _spread([proof.helper_ttc_s for proof in proofs]),
        ", ".join(f"{name} {count}" for name, count in helpers),
    ]
    return f"| {' | '.join(cells)} |"


def safe(scenario: Scenario, seeds: int) -> str:
    """Return a table row: the speed that the ego comes at, the safe one with own sight, and the time that it costs."""
    found = [safe_speed(find_encounter(scenario, seed).scenario, seed) for seed in range(1, seeds + 1)]
    known = [one for one in found if one is not None]
    if not known:
        return f"| {scenario.name} | - | - | - |"
    columns = (msgspec.structs.astuple(one) for one in known)
    return f"| {scenario.name} | {' | '.join(_spread(list(values)) for values in zip(*columns, strict=True))} |"


def _spread(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    text = f"{np.median(known):.1f} ({min(known):.1f} to {max(known):.1f})"
    never = len(values) - len(known)
    return f"{text}, {never} never" if never else text


def draw(scenario: Scenario, seed: int, out: Path) -> list[Path]:
    """Draw an encounter at the first detection of the conflict actor by the ego; return the files."""
    found = find_encounter(scenario, seed)
    now = _at_reveal(found.scenario, seed, found.proof)
    world = build_world(found.scenario, seed)
    layout = encounter_of(found.scenario, seed).layout
    roles = {one.name: one.roles for one in layout.actors}
    row = now.row(FIRST_ID)
    center, yaw = now.boxes.center[row], float(now.boxes.yaw[row])
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    ground = center[2] - 0.5 * now.boxes.size[row, 2]
    eye = np.array([center[0], center[1], ground + EYE_M]) + 0.2 * ahead
    conflict = now.boxes.center[now.row(FIRST_ID + 1)]
    middle = 0.5 * (center + conflict) * [1.0, 1.0, 0.0]
    span = float(np.hypot(*(conflict - center)[:2]))
    # From behind the ego, high enough for both to be in the picture.
    high = max(34.0, 1.45 * span + 16.0)
    far = middle - 0.25 * high * ahead + np.array([0.0, 0.0, high])
    look = yaw + _turned(yaw, conflict - eye)
    seat = (eye, eye + np.array([np.cos(look), np.sin(look), -0.03]), 84.0)
    above = (far, middle, 62.0)
    pictures = {
        "above": (picture(Stage.of(everything(world, now, -1)), *above), above, tuple(COLORS)),
        "ego": (picture(Stage.of(everything(world, now, FIRST_ID)), *seat), seat, ("conflict",)),
    }
    files = []
    out.mkdir(parents=True, exist_ok=True)
    for view, (pixels, camera, marked) in pictures.items():
        image = Image.fromarray(pixels)
        mark(image, camera, now, roles, marked)
        files.append(out / f"{scenario.name}_{view}.png")
        image.quantize(80, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(files[-1], optimize=True)
    return files


def _turned(yaw: float, offset: NDArray[np.float64]) -> float:
    """Return the head rotation that brings an offset into view, rad."""
    aside = float(wrap_angle(np.arctan2(offset[1], offset[0]) - yaw))
    return float(np.sign(aside)) * max(0.0, abs(aside) - np.radians(34.0))


def _at_reveal(scenario: Scenario, seed: int, proof: Proof) -> Actors:
    """Return the actors at the first detection of the conflict actor by the ego."""
    assert proof.hit_s is not None
    reveal_s = proof.hit_s - (proof.ego_ttc_s or 0.1)
    with ScriptedTraffic(scenario, seed) as traffic:
        while traffic.time_s < reveal_s - 1e-6:
            traffic.step()
        return traffic.actors


def mark(
    image: Image.Image, camera: tuple, now: Actors, roles: dict, marked: tuple[str, ...], size: tuple[int, int] = SIZE
) -> None:
    """Outline the boxes of the ego, the conflict actor and the helpers."""
    pen = ImageDraw.Draw(image)
    for row, name in enumerate(now.name):
        role = next((role for role in marked if role in roles.get(name, ())), None)
        if role is None:
            continue
        corners, depth = seen_at(camera, _corners(now.boxes[row : row + 1]), size)
        if depth.min() < 0.5:
            continue
        for a, b in _EDGES:
            pen.line([*corners[a], *corners[b]], fill=COLORS[role], width=2)


def _corners(box: Boxes) -> NDArray[np.float64]:
    return box.corners()[0]


def seen_at(
    camera: tuple, points: NDArray[np.float64], size: tuple[int, int] = SIZE
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (N, 2) pixels and (N,) depths of points in the picture of a camera."""
    eye, target, field_of_view_deg = camera
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    offset = points - eye
    depth = offset @ forward
    scale = 0.5 * size[0] / np.tan(np.radians(0.5 * field_of_view_deg)) / np.maximum(depth, 1e-3)
    return np.column_stack([0.5 * size[0] + scale * (offset @ right), 0.5 * size[1] - scale * (offset @ up)]), depth


if __name__ == "__main__":
    main()
