"""Command `dsrc score`: one set of boxes under published protocols."""

import sys

from dsrc.cli.progress import progress
from dsrc.options.detection import Scoring
from dsrc.options.fields import Folder, Output


class Score(Scoring, frozen=True, kw_only=True):
    """Score boxes of any detector under published protocols of average precision.

    Attributes:
        out: folder for scores.csv, scores.json, scores.md and scores.png; default: none.
    """

    out: Folder | None = None
    output: Output = Output()

    def run(self) -> None:
        """Score, print the table and write it."""
        from rich.console import Console

        from dsrc.evaluation.metrics.protocols import get_protocols
        from dsrc.evaluation.scoring.report import score_table, write_scores
        from dsrc.evaluation.scoring.score import provenance_of, score
        from sim.files import check_folder

        get_protocols(self.protocol)  # before the files are read
        if self.out is not None:
            check_folder(self.out)
        with progress(f"score {self.detections}") as report:
            found = score(self.detections, self.truth, self.protocol, corruption=self.corruption, progress=report)
        Console(highlight=False).print(score_table(found))
        if self.out is not None:
            write_scores(self.out, found, provenance_of(self))
            sys.stdout.write(f"{self.out}\n")
