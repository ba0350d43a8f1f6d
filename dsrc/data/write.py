"""Make a drive: traffic once, then frame by frame an OPV2V tree that a killed run can go on writing.

The order makes a resumed drive equal to an uninterrupted one: the traffic log comes first and is replayed from then
on, the protocol fixes the settings, and every frame depends on the log, the settings and its own number only.
"""

import logging
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.checksums import SUMS, write_sums
from dsrc.data.drive_folder import check_same, is_complete, locked, read_settings, write_protocol
from dsrc.data.executors import Progress
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.simulate import TRAFFIC_LOG, WORLD, open_live
from sensors.deskew import check_motion
from sensors.frame import Frame
from sensors.presets import scenario_lidars
from sensors.sweep import Motion
from sim.catalog.load import load_scenario
from sim.errors import SettingsError, complaint
from sim.files import remove_leftovers
from sim.mesh.materials import MATERIALS
from sim.scenario import Scenario

FORMAT = 4
_log = logging.getLogger(__name__)


class FrameSource(Protocol):
    """Frames by number, each independent of the others."""

    def frame(self, index: int) -> Frame:
        """Return one frame; the same bytes whenever it is asked for."""
        ...

    def plans(self, index: int) -> dict[int, NDArray[np.float64]]:
        """Return per agent (K, 3) x, y, m, and speed, m/s, of its way after the frame."""
        ...


Opener = Callable[[Path], AbstractContextManager[FrameSource]]
"""Opens the source of a drive whose traffic log is, or is to be put, at a path."""


@dataclass(frozen=True, slots=True)
class DriveSpec:
    """What one drive is.

    Attributes:
        scenario: what is simulated.
        seed: of everything random.
        frames: synchronised frames.
        interval_s: time between frames, s.
        connected_vehicles: list other agents' bodies among an agent's `vehicles`.
        motion: how the sensors' motion is compensated in the files; a reader can ask for another.
        visibility: measure which share of every object each agent's rays reach.
    """

    scenario: Scenario
    seed: int
    frames: int = 100
    interval_s: float = 0.1
    connected_vehicles: bool = True
    motion: Motion = "middle"
    visibility: bool = True

    @property
    def name(self) -> str:
        """Name of the drive's folder."""
        return f"{self.scenario.name}_{self.seed}"

    def settings(self) -> dict:
        """Return everything that decides the drive's bytes, in plain values."""
        return {
            "format": FORMAT,
            "scenario": msgspec.to_builtins(self.scenario),
            "seed": int(self.seed),
            "frames": int(self.frames),
            "interval_s": float(self.interval_s),
            "connected_vehicles": bool(self.connected_vehicles),
            "motion": self.motion,
            "visibility": bool(self.visibility),
            "materials": [material.name for material in MATERIALS],
            "axes": "CARLA: y mirrored, angles in degrees, half extents",
        }

    def check(self, where: str = "generate") -> None:
        """Refuse values out of their range, by name, before anything is made.

        Raises:
            SettingsError: a setting is out of its range.
            ScenarioError: a LiDAR is not known.
        """
        if self.frames < 1:
            raise SettingsError(complaint(where, "frames", "at least 1", self.frames))
        if self.seed < 0:
            raise SettingsError(complaint(where, "seed", "at least 0", self.seed))
        check_motion(self.motion)
        scenario_lidars(self.scenario)
        steps = self.interval_s / self.scenario.step_s
        if not (math.isfinite(steps) and self.interval_s > 0 and abs(steps - round(steps)) < 1e-6):
            expected = f"a positive multiple of the scenario's step of {self.scenario.step_s} s"
            raise SettingsError(complaint(where, "interval_s", expected, self.interval_s))
        if (self.frames - 1) * self.interval_s > self.scenario.duration_s:
            expected = f"a drive of at most {self.scenario.duration_s:g} s, the duration_s of {self.scenario.name}"
            found = f"{self.frames} frames every {self.interval_s:g} s"
            raise SettingsError(complaint(where, "frames", expected, found))


def generate(
    scenario: Scenario | str | Path,
    out: Path,
    frames: int = 100,
    seed: int | None = None,
    interval_s: float = 0.1,
    progress: Progress | None = None,
    connected_vehicles: bool = True,
    motion: Motion = "middle",
    visibility: bool = True,
) -> Path:
    """Simulate, scan and write one drive; start it again to go on after a stop.

    Args:
        scenario: a scenario, the name of a shipped one or the path of a .toml.
        out: the split folder; the drive is `out/<scenario>_<seed>`.
        frames: see `DriveSpec`, as all below.
        seed: None takes the scenario's.
        interval_s: s.
        progress: called after every frame.
        connected_vehicles: list other agents' bodies.
        motion: compensation in the files.
        visibility: measure visible fractions.

    Returns:
        The folder of the drive.

    Raises:
        DataError: the folder holds a drive made with other settings, or another process is writing it.
        SettingsError: a setting is out of its range.
    """
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    seed = scenario.seed if seed is None else seed
    spec = DriveSpec(scenario, seed, frames, interval_s, connected_vehicles, motion, visibility)
    spec.check()
    make_drive(spec, Path(out) / spec.name, progress)
    return Path(out) / spec.name


def make_drive(
    spec: DriveSpec,
    drive: Path,
    progress: Progress | None = None,
    recorded: Path | None = None,
    threads: int | None = None,
    more: dict | None = None,
    patience_s: float = 0.0,
) -> None:
    """Write the frames of a drive that are not there yet.

    Args:
        spec: what it is; of an encounter the first instance whose proof by rays holds is made.
        drive: its folder.
        progress: called after every frame.
        recorded: a folder with the drive's traffic log and world, see `open_live`.
        threads: see `sensors.scan.lidar.scan_all`.
        more: further entries of the protocol's settings; a `proof` among them is that of an encounter as it is.
        patience_s: how long to wait for another process in the drive's folder, s.
    """
    if len(spec.scenario.agents.roadside) > 1:
        _log.warning("%s: OpenCOOD takes a roadside unit as ego when a drive has more than one", spec.scenario.name)

    more = dict(more or {})
    if spec.scenario.conflict is not None and "proof" not in more:
        spec, more["proof"] = proven(spec)

    def open_source(log: Path) -> AbstractContextManager[FrameSource]:
        return open_live(
            spec.scenario,
            spec.seed,
            spec.frames,
            spec.interval_s,
            log,
            spec.visibility,
            recorded,
            threads,
            {name: more[name] for name in more if name == "proof"},
        )

    write_drive(drive, {**spec.settings(), **more}, open_source, progress, patience_s)


def proven(spec: DriveSpec) -> tuple[DriveSpec, dict]:
    """Return an encounter with the first draw whose proof by rays holds, and what the rays said.

    Raises:
        ScenarioError: no draw holds.
    """
    from sensors.recording.encounter_check import settle

    settled = settle(spec.scenario, spec.seed)
    proof = msgspec.to_builtins(settled)
    del proof["scenario"]
    return replace(spec, scenario=settled.scenario), proof


def write_drive(
    drive: Path,
    settings: dict,
    open_source: Opener,
    progress: Progress | None = None,
    patience_s: float = 0.0,
) -> None:
    """Write the frames of a drive that are not there yet.

    Args:
        drive: its folder.
        settings: what made it, plain values; must hold `frames`, `interval_s`, `seed`, `connected_vehicles` and
            `motion`.
        open_source: opens the frames; not called when the drive is finished.
        progress: called once at the start and after every frame.
        patience_s: how long to wait for another process in the folder, s.
    """
    report = progress or (lambda done, total: None)
    frames = settings["frames"]
    with locked(drive, patience_s):
        found = read_settings(drive)
        agents: dict = {}
        if found is not None:
            agents = found.pop("agents", {})
            check_same(drive, found, settings)
        else:
            # Without a protocol nobody knows what made a log or a world that lies here.
            for name in (TRAFFIC_LOG, WORLD):
                (drive / name).unlink(missing_ok=True)
        missing = [i for i in range(frames) if not agents or not is_complete(drive, list(agents), i)]
        done = frames - len(missing)
        report(done, frames)
        if missing:
            _log.info("%s: %d of %d frames to write", drive, len(missing), frames)
            with open_source(drive / TRAFFIC_LOG) as source:
                for i in missing:
                    frame = source.frame(i)
                    if found is None:
                        found = settings
                        write_protocol(drive, _protocol(settings, frame))
                    write_frame(
                        drive, frame, settings["connected_vehicles"], source.plans(i), motion=settings["motion"]
                    )
                    done += 1
                    report(done, frames)
        remove_leftovers(drive)
        if missing or not (drive / SUMS).exists():
            write_sums(drive)


def _protocol(settings: dict, frame: Frame) -> dict:
    """Return `data_protocol.yaml`: the keys that OpenCOOD's tools read, and everything of ours."""
    agents = {}
    for agent in frame.agents:
        lidar = msgspec.to_builtins(agent.sweep.spec) if agent.sweep.spec is not None else None
        agents[int(agent.agent_id)] = {"kind": agent.kind, "lidar": lidar}
    world = {"fixed_delta_seconds": settings["interval_s"], "seed": settings["seed"]}
    return {"world": world, "testbed": {**settings, "agents": agents}}
