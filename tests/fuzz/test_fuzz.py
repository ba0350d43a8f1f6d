"""A broken file for each reader; `make fuzz` takes 3,000, by a new seed."""

from pathlib import Path

import pytest

from tests.fuzz.foreign import foreign_targets
from tests.fuzz.run import fuzz


def test_files_of_others_are_read_before_they_are_mutated(tmp_path: Path) -> None:
    for target in foreign_targets(tmp_path):
        target.read(target.path)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs fork and limits of Linux")
def test_no_reader_has_a_stack_trace_or_hangs(tmp_path: Path) -> None:
    outcome = fuzz(tmp_path, inputs=40, seed=1)
    print(outcome)
    assert not outcome.traces and not outcome.hangs, "\n".join([*outcome.hangs, *outcome.traces])
    assert outcome.inputs > 130
