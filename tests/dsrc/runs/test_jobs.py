"""Jobs of a run are all done: their steps add up, and the first error comes after the last job."""

import pytest

from dsrc.runs.executors import SERIAL, Pool, Progress
from dsrc.runs.jobs import results_of, run_jobs
from sim.errors import DataError


def halve(job: int, report: Progress) -> int:
    if job < 0:
        raise DataError(f"{job}: expected a number of frames")
    report(1, 2)
    return job // 2


@pytest.mark.parametrize("pool", [SERIAL, Pool(workers=2)])
def test_steps_add_up_whatever_the_parts_of_a_job_are(pool: Pool) -> None:
    told: list[tuple[int, int]] = []
    results = results_of(halve, [4, 8], pool, lambda *steps: told.append(steps), [4, 8], done=3)
    assert sorted((result.row, result.value) for result in results) == [(0, 2), (1, 4)]
    assert told[0] == (3, 15) and told[-1] == (15, 15) and told == sorted(told) and len(told) == 5


def test_the_first_error_is_raised_when_the_others_are_done() -> None:
    told: list[tuple[int, int]] = []
    with pytest.raises(DataError, match="-1: expected"):
        run_jobs(halve, [4, -1, -2, 8], SERIAL, lambda *steps: told.append(steps))
    assert told[-1] == (2, 4)


def test_without_a_job_no_worker_is_started() -> None:
    told: list[tuple[int, int]] = []
    run_jobs(halve, [], Pool(executor="ray", address="nowhere"), lambda *steps: told.append(steps), done=7)
    assert told == [(7, 7)]
