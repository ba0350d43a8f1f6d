"""Jobs of a run: done by any number of workers, their progress summed, their errors collected."""

from collections.abc import Iterator, Sequence

from dsrc.runs.executors import Executor, Pool, Progress, Task, TaskResult
from sim.errors import UserError


def results_of(
    task: Task,
    jobs: Sequence[object],
    workers: Pool | Executor,
    progress: Progress | None = None,
    steps: Sequence[int] | None = None,
    done: int = 0,
    total: int | None = None,
) -> Iterator[TaskResult]:
    """Yield the results of jobs as they are ready.

    Args:
        task: function of one job, see `Task`.
        jobs: values that can be pickled.
        workers: pool that is opened for these jobs, or workers of an open one.
        progress: called with steps done and steps in all, at the start and whenever a job gets on.
        steps: of each job; default: 1.
        total: steps in all; default: `done` and those of these jobs.
    """
    if isinstance(workers, Pool):
        if jobs:
            with workers.open(len(jobs)) as executor:
                yield from results_of(task, jobs, executor, progress, steps, done, total)
        elif progress is not None:
            progress(done, done if total is None else total)
        return
    sizes, parts = list(steps or [1] * len(jobs)), [0] * len(jobs)
    in_all = done + sum(sizes) if total is None else total

    def report(row: int, part: int, of_parts: int) -> None:
        before, parts[row] = parts[row], sizes[row] * part // max(of_parts, 1)
        if progress is not None and parts[row] != before:
            progress(done + sum(parts), in_all)

    if progress is not None:
        progress(done, in_all)
    for result in workers.run(task, jobs, report):
        if result.error is None:
            report(result.row, 1, 1)
        yield result


def run_jobs(
    task: Task,
    jobs: Sequence[object],
    workers: Pool | Executor,
    progress: Progress | None = None,
    steps: Sequence[int] | None = None,
    done: int = 0,
    total: int | None = None,
) -> None:
    """Do all jobs, see `results_of`.

    Raises:
        UserError: of the first job that failed; the others are done.
    """
    errors: list[UserError] = []
    for result in results_of(task, jobs, workers, progress, steps, done, total):
        if result.error is not None:
            errors.append(result.error)
    if errors:
        raise errors[0]
