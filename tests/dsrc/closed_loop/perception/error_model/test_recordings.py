"""Error models of logs on disk and of stored detections."""

from pathlib import Path

import numpy as np
import pytest

from dsrc.closed_loop.perception.error_model.percepts import observed_table
from dsrc.closed_loop.perception.error_model.recordings import fit_model
from dsrc.closed_loop.perception.error_model.sight import SIGHTS
from dsrc.closed_loop.types import Percept
from dsrc.evaluation.detection_table import join_tables, one_frame
from dsrc.ops.detections import Detections
from sim.boxes import Boxes
from sim.errors import DataError
from sim.traffic.base import Actors
from tests.dsrc.closed_loop.logged import Mover, ahead, episode, percept_of
from tests.dsrc.closed_loop.perception import toy

MOVERS = [Mover("ego", ahead(5.0)), Mover("near", ahead(5.0, x=10.0, y=4.0)), Mover("far", ahead(5.0, x=-20.0))]


def sees(actors: Actors) -> Percept:
    """The near one always, the far one in every second percept."""
    every_second = [1, 2] if round(10 * actors.time_s) % 2 == 0 else [1]
    return percept_of(actors, every_second)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    toy.build(monkeypatch)
    for seed in (0, 1):
        log = episode(MOVERS, 40, sees=sees, scenario=toy.SCENARIO, seed=seed, perception="ego")
        log.save(tmp_path / "episodes" / f"{seed}.npz")
    return tmp_path


def test_a_campaign_is_fitted_by_its_logs(folder: Path) -> None:
    model = fit_model(folder)
    assert (model.perception, model.cooperative, model.interval_s) == ("ego", False, 0.1)
    assert model.classes == ("car", "van")
    (errors,) = model.conditions
    assert (errors.corruption, errors.episodes) == ("clean", 2)
    cells = [one for one in errors.cells if (one.kind, one.sight, one.range_m) == ("car", "clear", (15.0, 30.0))]
    (cell,) = (one for one in cells if one.found.after_yes.of == "cell")  # of those across the ego and those along it
    assert (cell.found.after_yes.p, cell.found.after_no.p) == (0.0, 1.0)  # found, missed, found, missed
    assert max(np.abs(cell.errors.bias).max(), max(cell.errors.sd)) < 2e-3  # the log's resolution
    assert errors.ghosts.born == 0.0
    assert fit_model(folder, seeds=(1,)).conditions[0].episodes == 1


def test_recordings_that_do_not_fit_are_one_line(folder: Path) -> None:
    with pytest.raises(DataError, match="logs: expected an episode of team, found none in 2 logs"):
        fit_model(folder, "team")
    with pytest.raises(DataError, match=r"logs: expected logs of episodes .*found no such folder"):
        fit_model(folder / "nowhere")
    log = episode(MOVERS, 5, sees=sees, scenario=toy.SCENARIO, perception="late")
    log.save(folder / "episodes" / "2.npz")
    with pytest.raises(DataError, match="perception: expected the same in all episodes, found ego, late"):
        fit_model(folder)
    log = episode(MOVERS, 5, sees=sees, scenario=toy.SCENARIO, perception="ego", loop={"look_ahead_s": 1.0})
    log.save(folder / "episodes" / "2.npz")
    with pytest.raises(DataError, match="look_ahead_s: expected the same in all episodes, found 0, 1"):
        fit_model(folder)


def test_stored_detections_know_who_sees_an_object() -> None:
    truth = Boxes.from_array([[10.0, 3 * row, 0, 4, 2, 1.5, 0] for row in range(4)], object_id=[1, 2, 3, 4])
    found = Detections(truth[np.array([0])], np.array([0.8], np.float32))
    points = np.array([[50, 50], [0, 40], [2, 2], [0, 0]])
    share = np.array([0.9, 0.0, 0.3, 0.0])
    frames = [one_frame(row, row, 7, found, truth, np.tile(points, 2), share) for row in (0, 1)]
    together = list(observed_table(join_tables(frames), cooperative=True))
    assert [SIGHTS[row] for row in together[1].sight] == ["clear", "helpers", "partly", "hidden"]
    assert [one.time_s for one in together] == [0.0, 0.1]
    alone = next(observed_table(join_tables(frames), cooperative=False))
    assert SIGHTS[alone.sight[1]] == "hidden"
    assert [rows.tolist() for rows in alone.matches()] == [[0], [0]]
