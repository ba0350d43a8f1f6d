"""Python interface of the testbed: drives, corruptions, detectors, evaluation, closed loop, own parts.

Names are imported when first used: `import dsrc` takes milliseconds. Everything in `__all__` keeps its meaning between
minor versions; modules below it may move.
"""

import sys as _sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

import dsrc.hidden as _hidden  # noqa: F401 - before anything of sim is imported
import dsrc.outputs as _outputs  # noqa: F401 - whoever writes knows what may be replaced

if TYPE_CHECKING:
    from dsrc.closed_loop.campaign.run import drive_episodes
    from dsrc.closed_loop.driving.check import check_driver
    from dsrc.closed_loop.driving.open import open_driver
    from dsrc.closed_loop.environments import register_environments
    from dsrc.closed_loop.environments.driving import DrivingEnv
    from dsrc.closed_loop.environments.parallel import parallel_env
    from dsrc.closed_loop.log import EpisodeLog
    from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
    from dsrc.closed_loop.metrics.episode import episode_metrics
    from dsrc.closed_loop.perception.open import open_perception
    from dsrc.closed_loop.replay import replay
    from dsrc.closed_loop.report.report import write_report
    from dsrc.closed_loop.report.terminal import summary_table
    from dsrc.closed_loop.team import TeamLoop
    from dsrc.closed_loop.types import Decision, EgoState, Outcome, Percept, Tracks
    from dsrc.data.clouds.corrupt import corrupt
    from dsrc.data.clouds.transform import CorruptTransform
    from dsrc.data.drives import Drive, open_drive, open_drives
    from dsrc.data.sample import Sample, SampleRequest, make_sample
    from dsrc.data.write import generate, simulate_frames
    from dsrc.detectors.check import check_detector
    from dsrc.detectors.open import open_detector
    from dsrc.evaluation.evaluate import evaluate_drives
    from dsrc.evaluation.report.ap_table import result_table
    from dsrc.evaluation.scoring.report import score_table
    from dsrc.evaluation.scoring.score import score
    from dsrc.messages.seen_space import SeenSpace
    from dsrc.models.detector import Detector, detect
    from dsrc.models.fusion import AgentLayout, Fusion, register_fusion
    from dsrc.models.fusion_check import check_fusion
    from dsrc.models.storage.checkpoint import load_detector
    from dsrc.ops.detections import Detections
    from dsrc.ops.grid import GridSpec
    from dsrc.options.detection import Evaluation
    from dsrc.review.page.app import view
    from dsrc.review.page.output.export import export_html
    from sensors.corruptions import check_corruption, corrupt_frame, kinds_of, register_corruption
    from sensors.deskew import deskew
    from sensors.frame import AgentFrame, Frame, Region
    from sensors.presets import get_lidar, register_sensor
    from sensors.presets.check import check_sensor
    from sensors.recording.scenario_check import check_scenario
    from sensors.scan.lidar import scan
    from sensors.scan.scene import RayScene
    from sensors.spec import LidarSpec
    from sensors.sweep import Sweep, make_sweep
    from sim.boxes import Boxes
    from sim.catalog.load import list_scenarios, load_scenario, register_scenario
    from sim.errors import UserError
    from sim.geometry import pose_matrix
    from sim.mesh.materials import material_index
    from sim.scenario import Scenario

_MODULES = {
    "dsrc.closed_loop.campaign.run": ("drive_episodes",),
    "dsrc.closed_loop.driving.check": ("check_driver",),
    "dsrc.closed_loop.driving.open": ("open_driver",),
    "dsrc.closed_loop.environments": ("register_environments",),
    "dsrc.closed_loop.environments.driving": ("DrivingEnv",),
    "dsrc.closed_loop.environments.parallel": ("parallel_env",),
    "dsrc.closed_loop.log": ("EpisodeLog",),
    "dsrc.closed_loop.loop": ("ClosedLoop", "LoopSettings"),
    "dsrc.closed_loop.metrics.episode": ("episode_metrics",),
    "dsrc.closed_loop.perception.open": ("open_perception",),
    "dsrc.closed_loop.report.report": ("write_report",),
    "dsrc.closed_loop.report.terminal": ("summary_table",),
    "dsrc.closed_loop.replay": ("replay",),
    "dsrc.messages.seen_space": ("SeenSpace",),
    "dsrc.closed_loop.team": ("TeamLoop",),
    "dsrc.closed_loop.types": ("Decision", "EgoState", "Outcome", "Percept", "Tracks"),
    "dsrc.data.clouds.corrupt": ("corrupt",),
    "dsrc.data.clouds.transform": ("CorruptTransform",),
    "dsrc.data.drives": ("Drive", "open_drive", "open_drives"),
    "dsrc.data.sample": ("Sample", "SampleRequest", "make_sample"),
    "dsrc.data.write": ("generate", "simulate_frames"),
    "dsrc.detectors.check": ("check_detector",),
    "dsrc.detectors.open": ("open_detector",),
    "dsrc.evaluation.evaluate": ("evaluate_drives",),
    "dsrc.evaluation.report.ap_table": ("result_table",),
    "dsrc.evaluation.scoring.report": ("score_table",),
    "dsrc.evaluation.scoring.score": ("score",),
    "dsrc.models.detector": ("Detector", "detect"),
    "dsrc.models.fusion": ("AgentLayout", "Fusion", "register_fusion"),
    "dsrc.models.fusion_check": ("check_fusion",),
    "dsrc.models.storage.checkpoint": ("load_detector",),
    "dsrc.ops.detections": ("Detections",),
    "dsrc.ops.grid": ("GridSpec",),
    "dsrc.options.detection": ("Evaluation",),
    "dsrc.review.page.app": ("view",),
    "dsrc.review.page.output.export": ("export_html",),
    "sensors.corruptions": ("check_corruption", "corrupt_frame", "kinds_of", "register_corruption"),
    "sensors.deskew": ("deskew",),
    "sensors.frame": ("AgentFrame", "Frame", "Region"),
    "sensors.presets": ("get_lidar", "register_sensor"),
    "sensors.presets.check": ("check_sensor",),
    "sensors.recording.scenario_check": ("check_scenario",),
    "sensors.scan.lidar": ("scan",),
    "sensors.scan.scene": ("RayScene",),
    "sensors.spec": ("LidarSpec",),
    "sensors.sweep": ("Sweep", "make_sweep"),
    "sim.boxes": ("Boxes",),
    "sim.catalog.load": ("list_scenarios", "load_scenario", "register_scenario"),
    "sim.errors": ("UserError",),
    "sim.geometry": ("pose_matrix",),
    "sim.mesh.materials": ("material_index",),
    "sim.scenario": ("Scenario",),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}
_RENAMED = {"drive": "drive_episodes", "look_again": "replay"}
"""New names by deprecated ones."""

__all__ = [
    # scenarios and their frames
    "Scenario",
    "list_scenarios",
    "load_scenario",
    "simulate_frames",
    "generate",
    # drives
    "Drive",
    "open_drive",
    "open_drives",
    "Frame",
    "AgentFrame",
    "Region",
    "Sweep",
    "Boxes",
    # sensing
    "LidarSpec",
    "get_lidar",
    "RayScene",
    "scan",
    "make_sweep",
    "deskew",
    "pose_matrix",
    "material_index",
    # corruptions
    "kinds_of",
    "corrupt",
    "corrupt_frame",
    "CorruptTransform",
    # detection
    "open_detector",
    "load_detector",
    "Detector",
    "detect",
    "Detections",
    "GridSpec",
    "Sample",
    "SampleRequest",
    "make_sample",
    "Evaluation",
    "evaluate_drives",
    "result_table",
    "score",
    "score_table",
    # closed loop and review
    "ClosedLoop",
    "TeamLoop",
    "LoopSettings",
    "open_perception",
    "open_driver",
    "Percept",
    "Tracks",
    "EgoState",
    "SeenSpace",
    "Decision",
    "Outcome",
    "EpisodeLog",
    "episode_metrics",
    "replay",
    "drive_episodes",
    "summary_table",
    "write_report",
    "DrivingEnv",
    "parallel_env",
    "register_environments",
    "export_html",
    "view",
    # parts of one's own
    "register_scenario",
    "check_scenario",
    "register_sensor",
    "check_sensor",
    "register_corruption",
    "check_corruption",
    "Fusion",
    "AgentLayout",
    "register_fusion",
    "check_fusion",
    "check_detector",
    "check_driver",
    "UserError",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from sim.machine import installed_versions  # as slow to import as all else here

        return next(iter(installed_versions(("dsrc-testbed", "dsrc-sensors")).values()))
    if name in _RENAMED:
        from sim.errors import warn_deprecated

        warn_deprecated(f"dsrc.{name}", f"dsrc.{_RENAMED[name]}")
        return getattr(import_module(__name__), _RENAMED[name])
    if name not in _HOME:
        raise AttributeError(f"module 'dsrc' has no attribute '{name}'")
    try:
        value = getattr(import_module(_HOME[name]), name)
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith("dsrc."):
            raise
        message = f"dsrc.{name} is in dsrc-testbed, not in the smaller dsrc-sensors that is installed"
        raise ModuleNotFoundError(message, name=error.name) from None
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})


if "gymnasium.envs.registration" in _sys.modules:
    # `gymnasium.make("dsrc:dsrc/Meta-v0")` imports what stands before the colon, in processes too; without an
    # installation no entry point registers the environments. Who has no gymnasium loaded loads nothing here.
    import_module("dsrc.closed_loop.environments")
