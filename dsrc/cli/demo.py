"""The demo: the whole walk on a real junction, from nothing to a table, plots, a page and an episode."""

import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

CHECKPOINTS = Path(__file__).parents[1] / "checkpoints"
"""The detectors that ship with the package, see `checkpoints/README.md` for the commands that made them."""

SCENARIO = "braunschweig"
TRAIN_SEED = 1
TEST_SEED = 903
"""No shipped detector was trained or validated on a drive of this seed."""


def run_demo(out: Path, quick: bool = False) -> None:
    """Generate a train and a test drive, evaluate the shipped detectors, draw, drive one episode, say where it is.

    Args:
        out: folder for everything; parts that are already there are kept.
        quick: a few frames only.

    Raises:
        UserError: when a part cannot be made.
    """
    from dsrc.closed_loop.episodes import drive_episodes
    from dsrc.data.write import generate
    from dsrc.evaluation.run import evaluate_checkpoints
    from dsrc.review.page.export import export_html
    from dsrc.review.page.screenshot import find_chromium, screenshot

    console = Console(highlight=False)
    start = time.perf_counter()
    train_frames, test_frames, interval_s, seconds = (4, 2, 1.0, 2.0) if quick else (20, 24, 1.5, 12.0)
    columns = (TextColumn("{task.description:34s}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:

        def follow(task: TaskID) -> Callable[[int, int], None]:
            return lambda done, total: progress.update(task, completed=done, total=total)

        drives = {}
        for split, seed, frames in (("train", TRAIN_SEED, train_frames), ("test", TEST_SEED, test_frames)):
            task = progress.add_task(f"{split} drive, {SCENARIO} seed {seed}", total=frames)
            drives[split] = generate(
                SCENARIO, out / split, frames=frames, seed=seed, interval_s=interval_s, progress=follow(task)
            )
        dsrc, plain = CHECKPOINTS / "small-dsrc.pt", CHECKPOINTS / "small-plain.pt"
        task = progress.add_task("evaluate, clean and six corruptions", total=None)
        table = evaluate_checkpoints(
            {"DSRC (SDD+PCP+REC)": dsrc, "plain student": plain},
            data=out / "test",
            out=out / "results",
            progress=follow(task),
        )
        task = progress.add_task("review page", total=2)
        page = export_html(out / "test", out / "review.html", checkpoint=dsrc)
        progress.update(task, completed=1)
        picture = screenshot(page, out / "review.png") if find_chromium() else None
        progress.update(task, completed=2)
        task = progress.add_task("closed-loop episode", total=None)
        episodes = drive_episodes(
            SCENARIO,
            perception="dsrc",
            checkpoint=dsrc,
            seeds=(TEST_SEED,),
            duration_s=seconds,
            out=out / "episode.csv",
            progress=follow(task),
        )
    console.print(table)
    console.print(episodes)
    for what, where in {
        "train drive": drives["train"],
        "test drive": drives["test"],
        "results": out / "results" / "results.csv",
        "AP per corruption": out / "results" / "ap_per_corruption.png",
        "mCE against mAP": out / "results" / "mce_map.png",
        "review page": page,
        "picture of it": picture or "none: no Chromium here",
        "episode": out / "episode.csv",
    }.items():
        console.print(f"{what:18s} {where}")
    console.print(
        f"done in {time.perf_counter() - start:.0f} s; look around: dsrc view {out / 'test'} --checkpoint {dsrc}"
    )
