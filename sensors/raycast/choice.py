"""Choice of the ray-casting engine."""

import logging
import os
from functools import lru_cache

from sensors.raycast.base import Engine
from sim.errors import SettingsError, complaint, did_you_mean

ENGINES = ("auto", "fused", "public")
VARIABLE = "DSRC_LIDAR_ENGINE"
"""Environment variable with the name of the default engine."""

log = logging.getLogger(__name__)


def open_engine(name: str | None = None) -> Engine:
    """Return an engine, one per process and kind.

    Args:
        name: one of `ENGINES`, None for that of the environment variable `DSRC_LIDAR_ENGINE` or else `auto`: the fused
            engine if it passes its self-test, which is done once, otherwise the public one, with a warning.

    Raises:
        SettingsError: unknown engine, or the fused one was named and cannot run.
    """
    wanted = name if name is not None else os.environ.get(VARIABLE) or "auto"
    if wanted not in ENGINES:
        what = "engine" if name is not None else VARIABLE
        raise SettingsError(complaint("LiDAR", what, "the name of an engine", wanted, did_you_mean(wanted, ENGINES)))
    if wanted == "public":
        return _public()
    engine, fault = _fused()
    if engine is not None:
        return engine
    if wanted == "fused":
        raise SettingsError(f"LiDAR: the fused engine cannot run here: {fault}")
    return _public()


@lru_cache(maxsize=1)
def _public() -> Engine:
    from sensors.raycast.public.engine import PublicEngine

    return PublicEngine()


@lru_cache(maxsize=1)
def _fused() -> tuple[Engine | None, str]:
    try:
        from sensors.raycast.fused.engine import FusedEngine
        from sensors.raycast.fused.selftest import self_test

        engine = FusedEngine()
        self_test(engine, _public())
        return engine, ""
    # Any failure of the compiler or of the foreign library leaves the slower engine usable.
    except Exception as error:
        fault = f"{type(error).__name__}: {error}".splitlines()[0]
    log.warning("LiDAR sweeps are made by the slower public engine: %s", fault)
    return None, fault
