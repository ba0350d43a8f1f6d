"""Command `dsrc demo`: the whole walk on a real junction, to a table, plots, a page and an episode."""

import time
from collections.abc import Mapping
from pathlib import Path

import msgspec

from dsrc.cli.progress import made, progress
from dsrc.options.fields import Folder, Output

SCENARIO = "braunschweig"
TRAIN_SEED = 1
TEST_SEED = 903
"""Seed of no drive that a shipped detector was trained or validated on."""

ENCOUNTER, ENCOUNTER_SEED = "lta_truck", 0
"""Encounter that cooperation decides, with seeds 1 and 2 too: the ego turns left, a truck opposite hides a car."""
ALONE, TOGETHER = "ego alone", "cooperative"


class Demo(msgspec.Struct, frozen=True, kw_only=True):
    """Walk through the testbed on a real junction: generate, evaluate, review, drive.

    About two minutes on two cores; an interrupted demo resumes.

    Examples:
        dsrc demo --quick

    Attributes:
        out: folder of everything that the demo writes.
        quick: a few frames only.
    """

    out: Folder = Path("demo")
    quick: bool = False
    output: Output = Output()

    def run(self) -> None:
        """Run the demo."""
        run_demo(self.out, self.quick)


def run_demo(out: Path, quick: bool = False) -> None:
    """Generate a train and a test drive, evaluate the shipped detectors, plot, drive, list the files.

    Args:
        out: folder of all files; finished parts are kept.

    Raises:
        UserError: a part failed.
    """
    from rich.console import Console

    from dsrc.closed_loop.campaign.run import drive_episodes
    from dsrc.closed_loop.report.terminal import summary_table
    from dsrc.data.write import generate
    from dsrc.detectors.texts import SHIPPED_DETECTOR
    from dsrc.evaluation.evaluate import Evaluation, evaluate_drives
    from dsrc.evaluation.report.ap_table import result_table
    from dsrc.evaluation.report.differences import stored_differences
    from dsrc.review.model import open_model
    from dsrc.review.page.output.export import export_html, picture, write_picture
    from dsrc.review.page.output.screenshot import find_chromium
    from dsrc.runs.executors import Pool
    from sim.files import check_folder

    check_folder(out)
    start = time.perf_counter()
    train_frames, test_frames, interval_s, seconds = (4, 2, 1.0, 2.0) if quick else (20, 24, 1.5, 20.0)
    drives = {}
    for split, seed, frames in (("train", TRAIN_SEED, train_frames), ("test", TEST_SEED, test_frames)):
        with progress(f"{split} drive, {SCENARIO} seed {seed}") as report:
            drives[split] = generate(
                SCENARIO, out / split, frames=frames, seed=seed, interval_s=interval_s, progress=report
            )
    dsrc = SHIPPED_DETECTOR
    plain, corrupted = (dsrc.with_name(f"small-{name}.pt") for name in ("plain", "dsrc-corrupted"))
    with progress("evaluate, clean and six corruptions") as report:
        checkpoints = (f"DSRC (SDD+PCP+REC)={dsrc}", f"plain student={plain}", f"DSRC, corrupted clouds={corrupted}")
        config = Evaluation(checkpoint=checkpoints, data=out / "test", out=out / "results")
        table = result_table(evaluate_drives(config, Pool(), report))
    with progress("review page") as report:
        page = export_html(out / "test", out / "review.html", checkpoint=str(dsrc))
        drawn = None
        if find_chromium():
            drawn = write_picture(picture(open_model(out / "test", str(dsrc)), ""), out / "review.png")
        report(1, 1)
    with progress(f"drive {ENCOUNTER} with four views of it") as report:
        driven = drive_episodes(
            ENCOUNTER,
            perception=("truth", "truth in sight=sight", f"{ALONE}=ego", f"{TOGETHER}=team"),
            seed=(ENCOUNTER_SEED,),
            duration_s=seconds,
            detect_every_s=0.2,
            out=out / "drive",
            progress=report,
        )
    console = Console(highlight=False)
    console.print(table, stored_differences(out / "results" / "results.json").terminal())
    console.print(summary_table(driven))
    console.print(lesson({result.perception: result.outcome for result in driven.results}))
    for what, where in {
        "train drive": drives["train"],
        "test drive": drives["test"],
        "results": out / "results" / "results.csv",
        "AP per corruption": out / "results" / "ap_per_corruption.png",
        "mCE against mAP": out / "results" / "mce_map.png",
        "review page": page,
        "its picture": drawn or "none, Chromium is missing",
        "closed loop": out / "drive" / "results.csv",
    }.items():
        console.print(f"{what:18s} {where}")
    spent_s = time.perf_counter() - start
    made([], f"all of this in {spent_s:.0f} s", "view", out / "test", "--checkpoint", dsrc)


def lesson(outcomes: Mapping[str, str]) -> str:
    """Return what the drives of an encounter show, in one line."""
    from dsrc.closed_loop.types import Outcome

    alone, together = outcomes[ALONE], outcomes[TOGETHER]
    if alone == Outcome.CRASHED and together == Outcome.ARRIVED:
        return "The same driver: alone it turns into the car that the truck hides; with its helpers' LiDARs it waits."
    if Outcome.DESYNCHRONISED in (alone, together):
        return "The drives end before the hidden car comes; without --quick they go on, and show who crashes."
    if alone == together:
        return f"Cooperation does not decide this drive: both {alone}."
    return f"Alone: {alone}; with helpers: {together}."
