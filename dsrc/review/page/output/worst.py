"""Pages of the worst frames that `dsrc stress` found."""

from pathlib import Path

from dsrc.evaluation.stress import SURE, Stress
from dsrc.review.model import open_model
from dsrc.review.page.output.export import export_states
from dsrc.review.state import ReviewState


def worst_pages(out: Path, found: Stress) -> list[Path]:
    """Write a review page of the worst frames of each drive, `worst_DRIVE.html`; see `dsrc view`."""
    if not found.worst:
        return []
    model, places = open_model(out), []
    names = [source.name for source in model.sources]
    for drive in dict.fromkeys(one.drive for one in found.worst):
        states = [
            ReviewState(
                drive=names.index(drive),
                frame=one.position,
                corruption=one.corruption,
                severity=one.severity,
                family=found.made_by["settings"]["family"][0],
                corrupted_agents=one.who,
                threshold=SURE,
                max_points=4000,
            )
            for one in found.worst
            if one.drive == drive
        ]
        places.append(export_states(model, states, out / f"worst_{drive}.html"))
    return places
