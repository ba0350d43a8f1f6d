"""Writing of a drive: the traffic log, then frame by frame an OPV2V tree; an interrupted run resumes.

A resumed drive equals an uninterrupted one: the traffic log is written first and replayed from then on, the protocol
fixes the settings, and a frame depends on the log, the settings and its number only. `simulate_frames` gives the same
frames in memory.
"""

import logging
import math
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.changes import at_place, in_world, with_sensors
from dsrc.data.checksums import CHECKSUMS, Written, write_checksums
from dsrc.data.drive_folder import TRAFFIC_LOG, WORLD, is_complete, read_settings, write_protocol
from dsrc.data.formats.opv2v.reader import CLOUDS, PROTOCOL, agent_table, with_clouds, write_frame
from dsrc.data.simulate import open_simulated
from dsrc.options.drives import DriveOptions, GenerateOptions
from dsrc.options.fields import takes_fields
from dsrc.runs.executors import Progress
from dsrc.runs.lock import locked
from dsrc.runs.series import check_same
from sensors.deskew import check_motion
from sensors.frame import Frame
from sensors.presets import scenario_lidars
from sim.catalog.load import load_scenario
from sim.errors import SettingsError, complaint
from sim.files import check_output, remove_leftovers
from sim.mesh.materials import MATERIALS
from sim.scenario import Scenario

FORMAT = 4
_log = logging.getLogger(__name__)


class FrameSource(Protocol):
    """Source of frames by number, each independent of the others."""

    def frame(self, index: int) -> Frame:
        """Return one frame; equal bytes for every call."""
        ...

    def plans(self, index: int) -> dict[int, NDArray[np.float64]]:
        """Return per agent (K, 3) x, y, m, and speed, m/s, of its path after the frame."""
        ...


Watch = Callable[[Frame], None]
"""Function that is shown every frame that is written."""
Opener = Callable[[Path], AbstractContextManager[FrameSource]]
"""Opener of a frame source: (path of the traffic log, existing or not) -> context manager."""


class DriveSpec(DriveOptions, frozen=True):
    """Specification of one drive.

    Attributes:
        scenario: the scenario.
        seed: of everything random.
        frames: synchronised frames.
    """

    scenario: Scenario
    seed: int
    frames: int = 100

    @property
    def name(self) -> str:
        """Name of the drive's folder."""
        return f"{self.scenario.name}_{self.seed}"

    def settings(self) -> dict:
        """Return all settings that decide the drive's bytes, as plain values."""
        settings = {
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
        return with_clouds(settings, self.clouds)

    def check(self, where: str = "generate") -> None:
        """Check the ranges of all settings.

        Raises:
            SettingsError: a setting is out of its range.
            ScenarioError: a LiDAR is unknown.
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


@takes_fields(GenerateOptions)
def generate(options: GenerateOptions, progress: Progress | None = None, watch: Watch | None = None) -> Path:
    """Simulate, scan and write one drive; an interrupted run resumes.

    Args:
        options: scenario, folder, frames and more, see `GenerateOptions`; or these as arguments.
        watch: called with every frame that is written.

    Returns:
        The folder of the drive.

    Raises:
        DataError: the folder holds a drive of other settings, or another process is writing it.
        SettingsError: a setting is out of its range.
    """
    scenario = options.scenario if isinstance(options.scenario, Scenario) else load_scenario(options.scenario)
    if options.vehicles is not None and options.vehicles < 0:
        raise SettingsError(complaint("generate", "--vehicles", "at least 0", options.vehicles))
    if options.vehicles is not None and scenario.conflict is not None:
        expected = f"none, as the encounter {scenario.name} names who carries a LiDAR"
        hint = "; dsrc dataset render writes its drive with fewer"
        raise SettingsError(complaint("generate", "--vehicles", expected, options.vehicles, hint))
    scenario = with_sensors(scenario, options.vehicles, options.lidar, options.roadside_lidar, options.roadside)
    scenario = in_world(scenario, options.world)
    if options.at is not None:
        scenario = at_place(scenario, options.at)
    seed = scenario.seed if options.seed is None else options.seed
    spec = DriveSpec(scenario, seed, options.frames, **options.shared())
    spec.check()
    drive = Path(options.out) / spec.name
    make_drive(spec, drive, progress, watch=watch)
    return drive


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


def make_drive(
    spec: DriveSpec,
    drive: Path,
    progress: Progress | None = None,
    recorded: Path | None = None,
    threads: int | None = None,
    more: dict | None = None,
    patience_s: float = 0.0,
    watch: Watch | None = None,
) -> None:
    """Write the missing frames of a drive.

    Args:
        spec: specification; for an encounter the first draw that the rays prove is taken.
        recorded: a folder with the drive's traffic log and world, see `open_simulated`.
        threads: see `sensors.scan.lidar.scan_all`.
        more: further entries of the protocol's settings; with a `proof` the encounter is taken as it is.
        patience_s: time to wait for another process in the drive's folder, s.
        watch: called with every frame that is written.
    """
    if len(spec.scenario.agents.roadside) > 1:
        _log.warning("%s: OpenCOOD takes a roadside unit as ego when a drive has more than one", spec.scenario.name)

    more = dict(more or {})
    if spec.scenario.conflict is not None and "proof" not in more:
        spec, more["proof"] = settle_encounter(spec)

    def open_source(log: Path) -> AbstractContextManager[FrameSource]:
        return open_simulated(
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

    write_drive(drive, {**spec.settings(), **more}, open_source, progress, patience_s, watch)


def settle_encounter(spec: DriveSpec) -> tuple[DriveSpec, dict]:
    """Return an encounter with its first draw that the rays prove, and the proof.

    Raises:
        ScenarioError: no draw is proven.
    """
    from sensors.recording.encounter_check import find_encounter

    found = find_encounter(spec.scenario, spec.seed)
    proof = msgspec.to_builtins(found)
    del proof["scenario"]
    return msgspec.structs.replace(spec, scenario=found.scenario), proof


def write_drive(
    drive: Path,
    settings: dict,
    open_source: Opener,
    progress: Progress | None = None,
    patience_s: float = 0.0,
    watch: Watch | None = None,
) -> None:
    """Write the missing frames of a drive from any source.

    Args:
        settings: of the drive, plain values; must hold `frames`, `interval_s`, `seed`, `connected_vehicles` and
            `motion`; of compact clouds also `clouds`.
        open_source: opens the frames; not called for a finished drive.
        progress: called once at the start and after every frame.
        patience_s: time to wait for another process in the folder, s.
        watch: called with every frame that is written.
    """
    report = progress or (lambda done, total: None)
    frames, clouds = settings["frames"], settings.get("clouds", "pcd")
    with locked(drive, patience_s):
        found = read_settings(drive)
        agents: dict = {}
        if found is not None:
            agents = found.pop("agents", {})
            check_same(drive / PROTOCOL, found, settings)
        else:
            # The protocol is written before any frame: these are another program's.
            for path in sorted(drive.glob("*/*")):
                if path.parent.name.lstrip("-").isdecimal() and path.suffix[1:] in (*CLOUDS, "yaml"):
                    check_output(path)
            # Without a protocol the settings of a log or a world are unknown.
            for name in (TRAFFIC_LOG, WORLD):
                (drive / name).unlink(missing_ok=True)
        missing = [i for i in range(frames) if not agents or not is_complete(drive, list(agents), i, clouds)]
        done, written = frames - len(missing), Written()
        report(done, frames)
        if missing:
            _log.info("%s: %d of %d frames to write", drive, len(missing), frames)
            with open_source(drive / TRAFFIC_LOG) as source:
                for i in missing:
                    frame = source.frame(i)
                    if found is None:
                        found = settings
                        # The keys that OpenCOOD's tools read, and ours.
                        world = {"fixed_delta_seconds": settings["interval_s"], "seed": settings["seed"]}
                        own = {**settings, "agents": agent_table(frame)}
                        write_protocol(drive, {"world": world, "testbed": own})
                    write_frame(
                        drive,
                        frame,
                        settings["connected_vehicles"],
                        source.plans(i),
                        motion=settings["motion"],
                        clouds=clouds,
                        write=written.write,
                    )
                    if watch is not None:
                        watch(frame)
                    done += 1
                    report(done, frames)
        remove_leftovers(drive)
        if missing or not (drive / CHECKSUMS).exists():
            write_checksums(drive, written)
