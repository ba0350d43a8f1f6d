"""Command `dsrc demo`: the whole walk on a real junction, to a table, plots, a page and an episode."""

import time
from pathlib import Path

import msgspec

from dsrc.cli.options import Folder
from dsrc.cli.progress import progress

CHECKPOINTS = Path(__file__).parents[1] / "checkpoints"
"""Shipped detectors; `checkpoints/README.md` has the commands that made them."""

SCENARIO = "braunschweig"
TRAIN_SEED = 1
TEST_SEED = 903
"""Seed of no drive that a shipped detector was trained or validated on."""


class Demo(msgspec.Struct, frozen=True, kw_only=True):
    """Walk through the testbed on a real junction: generate, evaluate, review, drive.

    About two minutes on two cores; an interrupted demo resumes.

    Attributes:
        out: folder of everything that the demo writes.
        quick: a few frames only.
    """

    out: Folder = Path("demo")
    quick: bool = False

    def run(self) -> None:
        """Run the demo."""
        run_demo(self.out, self.quick)


def run_demo(out: Path, quick: bool = False) -> None:
    """Generate a train and a test drive, evaluate the shipped detectors, plot, drive one episode, list the files.

    Args:
        out: folder of all files; finished parts are kept.
        quick: a few frames only.

    Raises:
        UserError: a part failed.
    """
    from rich.console import Console

    from dsrc.closed_loop.episodes import drive_episodes
    from dsrc.data.executors import Pool
    from dsrc.data.write import generate
    from dsrc.evaluation.evaluate import Evaluation, evaluate_drives
    from dsrc.evaluation.report.ap_table import result_table
    from dsrc.review.page.export import export_html
    from dsrc.review.page.screenshot import find_chromium, screenshot

    start = time.perf_counter()
    train_frames, test_frames, interval_s, seconds = (4, 2, 1.0, 2.0) if quick else (20, 24, 1.5, 12.0)
    drives = {}
    for split, seed, frames in (("train", TRAIN_SEED, train_frames), ("test", TEST_SEED, test_frames)):
        with progress(f"{split} drive, {SCENARIO} seed {seed}") as report:
            drives[split] = generate(
                SCENARIO, out / split, frames=frames, seed=seed, interval_s=interval_s, progress=report
            )
    dsrc, plain = CHECKPOINTS / "small-dsrc.pt", CHECKPOINTS / "small-plain.pt"
    with progress("evaluate, clean and six corruptions") as report:
        checkpoints = (f"DSRC (SDD+PCP+REC)={dsrc}", f"plain student={plain}")
        config = Evaluation(checkpoints=checkpoints, data=out / "test", out=out / "results")
        table = result_table(evaluate_drives(config, Pool(), report))
    with progress("review page") as report:
        page = export_html(out / "test", out / "review.html", checkpoint=dsrc)
        picture = screenshot(page, out / "review.png") if find_chromium() else None
        report(1, 1)
    with progress("closed-loop episode") as report:
        episodes = drive_episodes(
            SCENARIO,
            perception="dsrc",
            checkpoint=dsrc,
            seeds=(TEST_SEED,),
            duration_s=seconds,
            out=out / "episode.csv",
            progress=report,
        )
    console = Console(highlight=False)
    console.print(table)
    console.print(episodes)
    for what, where in {
        "train drive": drives["train"],
        "test drive": drives["test"],
        "results": out / "results" / "results.csv",
        "AP per corruption": out / "results" / "ap_per_corruption.png",
        "mCE against mAP": out / "results" / "mce_map.png",
        "review page": page,
        "its picture": picture or "none, Chromium is missing",
        "episode": out / "episode.csv",
    }.items():
        console.print(f"{what:18s} {where}")
    console.print(f"done in {time.perf_counter() - start:.0f} s; review: dsrc view {out / 'test'} --checkpoint {dsrc}")
