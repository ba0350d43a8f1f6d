"""Commands and examples run within the process of the tests, which has imported what they need."""

import contextlib
import io
import os
import runpy
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from unittest import mock

from dsrc.__main__ import main
from tests.paths import ROOT


def dsrc(*args: str) -> subprocess.CompletedProcess[str]:
    """Run the command line."""
    return _ended(["dsrc", *args], lambda: main(list(args)))


def run_script(path: Path, *args: str, env: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Run a script as `python path args` would."""
    with mock.patch.object(sys, "path", [str(path.parent), *sys.path]), mock.patch.dict(os.environ, env or {}):
        return _ended([str(path), *args], lambda: runpy.run_path(str(path), run_name="__main__"))


def run_study(name: str, *args: str) -> subprocess.CompletedProcess[str]:
    """Run a study as `python -m studies.NAME args` would."""
    path = ROOT.joinpath("studies", *name.split(".")).with_suffix(".py")
    return _ended([str(path), *args], lambda: runpy.run_path(str(path), run_name="__main__"))


def study(name: str, *args: str) -> str:
    """Return what a study printed that ended well."""
    with mock.patch.dict(os.environ, {"DSRC_LIDAR_ENGINE": "public"}):
        done = run_study(name, *args)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _ended(words: list[str], run: Callable[[], object]) -> subprocess.CompletedProcess[str]:
    out, err, code = io.StringIO(), io.StringIO(), 0
    with mock.patch.object(sys, "argv", words), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            run()
        except SystemExit as leaving:
            if isinstance(leaving.code, str):
                err.write(f"{leaving.code}\n")
            code = 1 if isinstance(leaving.code, str) else int(leaving.code or 0)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())
