"""Memory and threads of a process."""

import os
import platform
import subprocess
import sys

import pytest

from sim.machine import core_count

FAULTS = """
import resource
import numpy as np
from sim.machine import keep_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(16_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

faults()
print(faults())
keep_memory()
faults()
print(faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs the GNU C library")
def test_memory_that_is_kept_comes_without_page_faults() -> None:
    done = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, timeout=60, check=True)
    given_back, kept = map(int, done.stdout.split())
    assert kept < 100 and kept < given_back


THREADS = """
import os, sys
from sim.machine import single_thread_products
if sys.argv[1] == "single":
    single_thread_products()
import numpy as np
points = np.ones((100_000, 3))
for _ in range(3):
    points @ np.eye(3)
print(len(os.listdir("/proc/self/task")))
"""


@pytest.mark.skipif(not os.path.isdir("/proc/self/task") or core_count() < 2, reason="needs Linux and two cores")
def test_matrix_products_take_one_thread_unless_the_user_says() -> None:
    def threads(how: str, **told: str) -> int:
        free = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
        command = [sys.executable, "-c", THREADS, how]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True, env=free | told)
        return int(done.stdout)

    assert threads("single") == 1 < threads("as it is")
    assert threads("single", OPENBLAS_NUM_THREADS="2") == 2
