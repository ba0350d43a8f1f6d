"""Trainings for real roads: runs follow their starts and teachers, and the recipes read heights above the ground."""

from studies.shipped.train import BATCH, PLAN, STARTS


def test_every_run_comes_after_what_it_starts_from_and_is_taught_by() -> None:
    known = {path.stem for path in STARTS.glob("*.pt")}
    for run in PLAN:
        assert run.start in known and (not run.teacher or run.teacher in known)
        known.add(run.name)


def test_recipes_are_of_heights_above_the_ground_and_of_their_steps() -> None:
    for run in PLAN:
        recipe = run.recipe()
        assert recipe.model.height == "ground" and recipe.settings(run.stage).height == "ground"
        assert recipe.epoch_frames is not None and recipe.batch_size == BATCH
        assert recipe.epochs * recipe.epoch_frames == BATCH * run.steps
        tried = run.recipe(0.001)
        assert tried.epoch_frames is not None and tried.epochs * tried.epoch_frames <= BATCH * max(run.steps // 500, 1)


def test_dsrc_differs_from_plain_by_its_teacher_alone() -> None:
    runs = {run.name: run for run in PLAN}
    for name in ("alone", ""):
        plain, taught = (runs["-".join(filter(None, (kind, name)))] for kind in ("plain", "dsrc"))
        assert (plain.steps, plain.rate) == (taught.steps, taught.rate) and taught.teacher and not plain.teacher
