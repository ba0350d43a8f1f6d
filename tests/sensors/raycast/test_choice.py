"""Which engine serves, and what happens when the fused one cannot."""

import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from sensors import motion
from sensors.optics.beams import beams_of
from sensors.optics.reflectance import optics_of
from sensors.presets import get_lidar
from sensors.raycast import choice, open_engine
from sensors.raycast.base import Bodies, EngineUnavailable, Returns, Solid, SweepRequest
from sensors.raycast.fused import embree, selftest
from sensors.raycast.fused import engine as fused
from sensors.scan.lidar import Sensor, scan, scan_all
from sensors.scan.scene import RayScene
from sensors.sweep import Sweep
from sim.errors import SettingsError
from sim.geometry import pose_matrix
from tests.paths import ROOT
from tests.sensors.fakes import box, box_body, cars, ground

SENSOR = pose_matrix([0.0, 0.0, 1.9])


def sweep_by(engine: str | None) -> tuple[str, Sweep]:
    scene = RayScene(ground() + box((8, 20, 9), (25.0, 0.0, 4.5)), body_mesh=box_body, engine=engine)
    scene = scene.with_bodies(cars([[9.0, 4.0, 0.4]], speed=7.0))
    return scene.engine.name, scan(scene, get_lidar("debug-16"), SENSOR, SENSOR, 0.0, np.random.default_rng(0))


@pytest.fixture
def untried(monkeypatch: pytest.MonkeyPatch) -> None:
    """No engine has been opened yet, and the user asks for none; `library` is loaded anew."""
    monkeypatch.delenv(choice.VARIABLE, raising=False)
    monkeypatch.setattr(choice, "_fused", lru_cache(maxsize=2)(choice._fused.__wrapped__))
    monkeypatch.setattr(fused, "library", embree.library.__wrapped__)


def missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(embree, "_NAMES", ("libembree5.so",))


def of_another_version(monkeypatch: pytest.MonkeyPatch) -> None:
    # Where the library is asked for its version it says how many packets of 16 rays it traces natively: 0 or 1.
    monkeypatch.setattr(embree, "_VERSION", embree._NATIVE_WIDTHS[16])


def not_loadable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(embree._SIGNATURES, "rtcNewTelescope", (None, ()))


def with_other_points(monkeypatch: pytest.MonkeyPatch) -> None:
    right = fused.FusedEngine.sweep

    def wrong(*args: Any) -> list[Returns]:
        return [returns._replace(points=returns.points + np.float32(0.01)) for returns in right(*args)]

    monkeypatch.setattr(fused.FusedEngine, "sweep", wrong)


FAULTS = {
    missing: "embreex's wheel carries no Embree library",
    of_another_version: "is Embree [01], not 4.x",
    not_loadable: "cannot be loaded: .*rtcNewTelescope",
    with_other_points: "its self-test failed: [0-9]+ of 3200 returns differ",
}


@pytest.mark.parametrize(("fault", "says"), FAULTS.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_where_the_fused_engine_cannot_run_the_public_one_makes_the_same_points(
    untried: None,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    fault: Callable[[pytest.MonkeyPatch], None],
    says: str,
) -> None:
    expected_name, expected = sweep_by("fused")
    assert expected_name == "fused"
    choice._fused.cache_clear()
    fault(monkeypatch)
    with caplog.at_level(logging.WARNING):
        name, made = sweep_by(None)
        assert sweep_by("auto")[0] == name == "public"
    (warning,) = caplog.messages
    assert warning.startswith("LiDAR sweeps are made by the slower public engine: EngineUnavailable: ")
    caplog.clear()
    with pytest.raises(SettingsError, match=f"LiDAR: the fused engine cannot run here: EngineUnavailable: .*{says}"):
        open_engine("fused")
    assert len(made) == len(expected) > 1000
    np.testing.assert_allclose(made.points, expected.points, atol=5e-4)
    np.testing.assert_allclose(made.intensity, expected.intensity, atol=4e-3)
    for field in ("ring", "column", "object_id", "material"):
        np.testing.assert_array_equal(getattr(made, field), getattr(expected, field))


def test_engines_that_work_pass_the_self_test(untried: None, caplog: pytest.LogCaptureFixture) -> None:
    assert open_engine().name == "fused"
    assert not caplog.messages


class Faulty:
    """The public engine, but for a fault in what it is asked or in what it answers."""

    def __init__(self, spec: dict[str, Any] | None = None, answer: Callable[[Returns], Returns] | None = None) -> None:
        self._spec = spec or {}
        self._answer = answer or (lambda returns: returns)

    def sweep(self, static: Solid, bodies: Bodies, requests: Sequence[SweepRequest], threads: int) -> list[Returns]:
        made = open_engine("public").sweep(static, bodies, [self._changed(request) for request in requests], threads)
        return [self._answer(returns) for returns in made]

    def _changed(self, request: SweepRequest) -> SweepRequest:
        spec = msgspec.structs.replace(request.spec, **self._spec)
        return replace(request, spec=spec, beams=beams_of(spec, 0.0), optics=optics_of(spec))


def scaled(field: str, by: float) -> Callable[[Returns], Returns]:
    return lambda returns: returns._replace(
        **{field: (getattr(returns, field) * by).astype(getattr(returns, field).dtype)}
    )


@pytest.mark.parametrize(
    "fault",
    [
        Faulty({"subrays": 1}),
        Faulty({"returns": "strongest"}),
        Faulty({"angle_noise_deg": 0.0}),
        Faulty({"range_noise_m": 0.0}),
        Faulty({"prisms": ()}),
        Faulty({"dropoff_rate": 0.0}),
        Faulty({"dropoff_zero_intensity": 0.0}),
        Faulty({"range_10_m": 100.0}),
        Faulty({"pulse_s": 1e-8}),
        Faulty({"firing_s": ()}),
        Faulty({"intensity_law": "reflectivity"}),
        Faulty(answer=scaled("intensity", 0.97)),
        Faulty(answer=scaled("cosine", 0.97)),
        Faulty(answer=scaled("time_offset", 0.99)),
        Faulty(answer=scaled("material", 0)),
        Faulty(answer=scaled("object_id", 2)),
        Faulty(answer=lambda returns: returns._replace(points=returns.points[:, [1, 0, 2]])),
    ],
)
def test_an_engine_that_gets_one_thing_wrong_fails_the_self_test(fault: Faulty) -> None:
    with pytest.raises(EngineUnavailable, match="self-test failed"):
        selftest.self_test(fault, open_engine("public"))


CACHES = {"none": "NullCache", "writable": "FunctionCache"}
"""Classes of numba by the state of the home folder."""


@pytest.mark.parametrize("home", CACHES)
def test_the_kernel_is_compiled_without_a_cache_where_nothing_can_be_written(tmp_path: Path, home: str) -> None:
    """A regular file in place of each folder keeps even the superuser from writing there."""
    package = shutil.copytree(ROOT / "sensors", tmp_path / "sensors", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "sim", tmp_path / "sim", ignore=shutil.ignore_patterns("__pycache__"))
    (package / "raycast" / "fused" / "__pycache__").write_text("")
    folder = tmp_path / "home"
    folder.write_text("") if home == "none" else folder.mkdir()
    kept = {key: value for key, value in os.environ.items() if key not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    code = "from sensors.raycast.fused import kernel; print(kernel.__file__, type(kernel.sweep_rings._cache).__name__)"
    result = subprocess.run(
        [sys.executable, "-B", "-c", code],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=kept | {"HOME": str(folder), "LOCALAPPDATA": str(folder), "PYTHONPATH": str(tmp_path)},
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == [str(package / "raycast" / "fused" / "kernel.py"), CACHES[home]]
    assert result.stderr.count("each process compiles them anew") == (home == "none")


def test_an_interrupted_sweep_is_done_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = RayScene(ground(), body_mesh=box_body, engine="fused")
    here, there = (scene.with_bodies(cars([[x, 0.0, 0.0]])) for x in (8.0, 20.0))
    expected = scan(here, get_lidar("debug-16"), SENSOR, SENSOR, 0.0, np.random.default_rng(0))
    sight = fused.sight_bodies

    def interrupted(*args: Any) -> None:
        sight(*args)
        raise KeyboardInterrupt

    monkeypatch.setattr(fused, "sight_bodies", interrupted)
    with pytest.raises(KeyboardInterrupt):
        scan(there, get_lidar("debug-16"), SENSOR, SENSOR, 0.0, np.random.default_rng(0))
    monkeypatch.undo()
    again = scan(here, get_lidar("debug-16"), SENSOR, SENSOR, 0.0, np.random.default_rng(0))
    assert (expected.object_id == 1000).sum() > 20
    np.testing.assert_array_equal(again.points, expected.points)


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals cannot be sent to a thread here")
def test_an_interrupted_sweep_keeps_its_lock_until_its_workers_have_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = RayScene(ground(), body_mesh=box_body, engine="fused")
    path = motion.Path.through([-0.05, 0.05], [SENSOR, SENSOR])
    sensor = Sensor(get_lidar("debug-16"), path, 0.0, np.random.default_rng(0))
    make = fused._SweepTask.make
    begun, ended = [], []

    def slowly(*args: Any) -> Any:
        begun.append(threading.get_ident())
        time.sleep(0.3)
        ended.append(threading.get_ident())
        return make(*args)

    def impatient() -> None:
        for _ in range(2):
            time.sleep(0.1)
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    monkeypatch.setattr(fused._SweepTask, "make", slowly)
    # A background job of a shell ignores interrupts by default.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    user = threading.Thread(target=impatient)
    user.start()
    with pytest.raises(KeyboardInterrupt):
        scan_all(scene, [sensor], threads=2)
    still_at_work, locked = len(begun) - len(ended), scene.engine._lock.locked()
    user.join()
    signal.signal(signal.SIGINT, before)
    assert begun and still_at_work == 0 and not locked
    # No further task begins.
    assert len(begun) <= 2
    monkeypatch.undo()
    assert len(scan_all(scene, [sensor], threads=2)[0]) > 1000
