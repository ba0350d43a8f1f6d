"""Options of commands that write drives: `dsrc generate`, `corrupt` and `dataset`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from msgspec import Meta
from tyro.conf import arg

from dsrc.options.fields import CORRUPTIONS, AgentsText, Data, Family, Folder, Scenario, Splits, choice

if TYPE_CHECKING:
    from sim import scenario

    AnyScenario = scenario.Scenario | str | Path
    Place = str | tuple[float, float]
    Columns = str | Sequence[str]
    IntensityScale = str | float
else:
    AnyScenario = Scenario
    Place = Annotated[str, arg(metavar="X,Y")]
    Columns = Annotated[str, arg(metavar="NAME[,NAME...]")]
    IntensityScale = Annotated[str, arg(metavar="{NUMBER,waymo}")]
"""Scenario, its name or the path of its file; on the command line one of the latter."""


class DriveOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options that drives of any scenario share.

    Attributes:
        interval_s: time between frames, a multiple of the LiDAR's 0.1 s, s.
        motion: instant of a sweep to which its points are motion-compensated; raw: not at all.
        connected_vehicles: list the other agents among an agent's vehicles; OPV2V leaves them out.
        visibility: measure the visible share of every object, for a fifth of the time.
        clouds: form of the point clouds: pcd, which tools of OPV2V read, or compact, the same in a quarter of the
            bytes for this project's readers alone.
    """

    interval_s: Annotated[float, Meta(gt=0.0)] = 0.1
    motion: Literal["middle", "start", "end", "raw"] = "middle"
    connected_vehicles: bool = True
    visibility: bool = True
    clouds: Literal["pcd", "compact"] = "pcd"

    def shared(self) -> dict[str, Any]:
        """Return these options by name."""
        return {name: getattr(self, name) for name in DriveOptions.__struct_fields__}


class GenerateOptions(DriveOptions, frozen=True):
    """Options of a drive and its place.

    Attributes:
        scenario: shipped scenario, or path of a scenario.toml.
        out: parent folder; the drive becomes FOLDER/SCENARIO_SEED.
        frames: synchronised frames.
        seed: seed of everything random; default: the scenario's.
        vehicles: number of vehicles with a LiDAR, the ego included; default: the scenario's.
        lidar: preset of the vehicles' LiDARs, such as vlp-16; default: the scenario's.
        roadside: keep the roadside units of the scenario.
        roadside_lidar: preset of the roadside units' LiDARs; default: the scenario's.
        at: point of the scenario's world, m, around which agents drive: they and the roadside units within 150 m of it
            to each side take part; default: the scenario's area.
        world: version of the world: 1 level and bare, 2 uneven and furnished; default: the scenario's.
    """

    scenario: AnyScenario
    out: Folder
    frames: int = 100
    seed: int | None = None
    vehicles: int | None = None
    lidar: str | None = None
    roadside: bool = True
    roadside_lidar: str | None = None
    at: Place | None = None
    world: Literal[1, 2] | None = None


class CorruptOptions(msgspec.Struct, frozen=True):
    """Options of corrupted drives and scans.

    Attributes:
        data: a drive, or a folder of drives; or a scan of another data set (.bin of KITTI, .pcd.bin of nuScenes, .npy,
            .pcd, .ply), or a folder of scans.
        out: folder of the corrupted drives or scans, which keep their names; the drive or the file itself where `data`
            is one.
        corruption: kind of the corruption.
        severity: severity of the corruption, 1 to 5; default: 3, or the preset's.
        family: models of the corruption: of physical causes, or as published in papers; default: physical, or the
            preset's.
        preset: published settings in place of severity and family, such as robo3d_heavy; default: none.
        corrupted_agents: agents whose sweeps are corrupted, by word or by their ids; weather at some alone is a
            counterfactual: it acts on their sensors and nowhere else.
        set: settings in place of the severity's, such as calibration=hdl64.npz; default: none.
        sensor: preset of the LiDAR of scans, such as hdl-64e-s2; default: rings are found in the points.
        columns: columns of scans in .bin, .pcd.bin or .npy, such as x,y,z,intensity,ring,time; further ones stay with
            their points, _ is any; default: those of the format.
        intensity_scale: intensity of scans that means 1, such as 65535, or waymo; default: 1 or 255, found over all
            scans.
        seed: seed of the corruption; every drive draws its own weather and faults from it.
        reuse: folders of earlier corruptions, perhaps `out`: frames and scans whose settings agree in all but code are
            taken from them, which is recorded; default: none.
    """

    data: Data
    out: Path
    corruption: Annotated[str, choice(CORRUPTIONS)]
    severity: int | None = None
    family: Family | None = None
    preset: str | None = None
    corrupted_agents: AgentsText = "all"
    set: Annotated[tuple[str, ...], arg(metavar="FIELD=VALUE [...]")] = ()
    sensor: str | None = None
    columns: Columns | None = None
    intensity_scale: IntensityScale | None = None
    seed: int = 0
    reuse: tuple[Folder, ...] = ()


class BuildOptions(msgspec.Struct, frozen=True):
    """Options of a dataset.

    Attributes:
        dataset: shipped dataset, or path of a TOML of splits.
        out: folder of the dataset; drives are FOLDER/SPLIT/DRIVE.
        splits: splits to build; default: all.
        cards: write a data card beside each split.
    """

    dataset: Splits
    out: Folder
    splits: tuple[str, ...] = ()
    cards: bool = True


class Changes(msgspec.Struct, frozen=True, kw_only=True):
    """Sensors and agents of a rendered drive that differ from the recording.

    Attributes:
        lidar: preset of the vehicles' LiDARs, such as vlp-16; default: the recording's.
        roadside_lidar: preset of the roadside units' LiDARs; default: the recording's.
        roadside: keep the roadside units.
        vehicles: number of vehicles with a LiDAR; default: the recording's.
        agent_id: ids of the vehicles with a LiDAR, in tracks those of their file; default: the recording's.
        mount: x y z in the body frame, m, and pitch, deg, of the vehicles' LiDARs; default: the recording's.
        frames: frames of each drive, from the first; default: all.
    """

    lidar: str | None = None
    roadside_lidar: str | None = None
    roadside: bool = True
    vehicles: int | None = None
    agent_id: tuple[int | str, ...] = ()
    mount: tuple[float, float, float, float] | None = None
    frames: int | None = None


class ConvertOptions(msgspec.Struct, frozen=True):
    """Options of drives in another format.

    Attributes:
        data: a drive, or a folder of drives, in any supported format; a split of a DAIR-V2X-C tree is TREE/val.
        out: folder of the new tree.
        to: new format; compact is OPV2V with compact clouds; mcap, for Foxglove, needs the package mcap;
            ros2, MCAP of ROS 2 messages, needs rosbags; osi (.osi traces) and osi-mcap need betterosi.
        agent_id: agent whose sweeps are written to KITTI, nuScenes and DAIR: ego, all (not DAIR) or an id; default:
            ego.
        view: labels of KITTI: those in the picture of a nominal camera, or all around.
    """

    data: Data
    out: Folder
    to: Literal["opv2v", "compact", "dair", "kitti", "mcap", "ros2", "nuscenes", "osi", "osi-mcap"]
    agent_id: Annotated[str | None, arg(metavar="{ego,all,INT}")] = None
    view: Literal["camera", "around"] = "camera"
