"""Frames of a scenario in memory: simulated and scanned, nothing written."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

from dsrc.data.simulate import TRAFFIC_LOG, open_simulated
from dsrc.data.write import DriveSpec, settle_encounter
from sensors.frame import Frame
from sim.catalog.load import load_scenario
from sim.scenario import Scenario


def simulate_frames(
    scenario: Scenario | str | Path,
    frames: int = 100,
    seed: int | None = None,
    interval_s: float = 0.1,
    *,
    visibility: bool = True,
) -> Iterator[Frame]:
    """Frames of a drive, one after the other, as `generate` writes them but for the rounding of files.

    Args:
        scenario: a scenario, its name or its path.
        seed: of everything random; None for the scenario's.
        interval_s: time between frames, s.

    Raises:
        ScenarioError: the scenario is unknown or not valid, or has too few vehicles for its agents.
        SettingsError: a setting is out of its range.
    """
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    seed = scenario.seed if seed is None else seed
    spec = DriveSpec(scenario, seed, frames, interval_s=interval_s, visibility=visibility)
    spec.check("simulate_frames")
    return _frames(spec)


def _frames(spec: DriveSpec) -> Iterator[Frame]:
    if spec.scenario.conflict is not None:
        spec, _ = settle_encounter(spec)
    with tempfile.TemporaryDirectory(prefix="dsrc-") as folder:
        log = Path(folder) / TRAFFIC_LOG
        with open_simulated(spec.scenario, spec.seed, spec.frames, spec.interval_s, log, spec.visibility) as source:
            yield from (source.frame(index) for index in range(spec.frames))
