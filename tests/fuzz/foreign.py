"""Readers of what is not ours in format: scans, tracks and boxes; and error models, whoever made them."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dsrc.closed_loop.perception.error_model.fit import fit_errors
from dsrc.closed_loop.perception.error_model.model import ErrorModel, read_model, write_model
from dsrc.data.datasets.corrupt import corrupt_dataset
from dsrc.data.datasets.tracks import record_tracks
from dsrc.data.formats.kitti import encode_labels
from dsrc.evaluation.scoring.score import score
from sim.boxes import Boxes
from tests.dsrc.closed_loop.perception.error_model.percepts import INTERVAL_S, sequence
from tests.dsrc.data.clouds.test_corrupt import BOXES, street
from tests.fuzz.target import Target
from tests.sim.traffic.tracks.test_datasets import write_highd, write_ind, write_interaction
from tests.sim.traffic.tracks.test_tracks import write_csv, write_npz, write_xml

META = ("tracksMeta", "recordingMeta")
FCD = """<fcd-export><timestep time="0.00">
<vehicle id="a" x="34.37" y="-1.60" angle="90.00" type="suv" speed="14.73" pos="34.37" lane="e_1" slope="0.00"/>
<person id="b" x="20.00" y="-4.80" z="0.5" angle="90.00" type="DEFAULT_PEDTYPE" speed="0.00" edge="e" slope="0.0"/>
</timestep><timestep time="0.50">
<vehicle id="a" x="41.73" y="-1.60" angle="90.00" type="suv" speed="14.73" pos="41.73" lane="e_1" slope="0.00"/>
</timestep></fcd-export>
"""
CUT_IN = """<OpenSCENARIO><FileHeader revMajor="1" revMinor="1"/>
<ParameterDeclarations><ParameterDeclaration name="v" parameterType="double" value="15"/></ParameterDeclarations>
<RoadNetwork><LogicFile filepath="road.xodr"/></RoadNetwork>
<Entities><ScenarioObject name="a"><Vehicle name="a" vehicleCategory="car"><BoundingBox><Center x="1.4" y="0" z="0.75"/>
<Dimensions width="1.8" length="4.5" height="1.5"/></BoundingBox></Vehicle></ScenarioObject>
<ScenarioObject name="b"><Vehicle name="b" vehicleCategory="truck"><BoundingBox><Center x="1.4" y="0" z="0.75"/>
<Dimensions width="1.8" length="4.5" height="1.5"/></BoundingBox></Vehicle></ScenarioObject></Entities>
<Storyboard><Init><Actions><Private entityRef="a"><PrivateAction><TeleportAction><Position>
<LanePosition roadId="7" laneId="-1" s="10" offset="0.1"/></Position></TeleportAction></PrivateAction><PrivateAction>
<LongitudinalAction><SpeedAction><SpeedActionDynamics dynamicsShape="linear" value="1" dynamicsDimension="time"/>
<SpeedActionTarget><AbsoluteTargetSpeed value="$v"/></SpeedActionTarget></SpeedAction></LongitudinalAction>
</PrivateAction></Private><Private entityRef="b"><PrivateAction><TeleportAction><Position>
<RelativeLanePosition entityRef="a" dLane="-1" ds="12"/></Position></TeleportAction></PrivateAction></Private>
</Actions></Init><Story name="s"><Act name="s"><ManeuverGroup name="g" maximumExecutionCount="1">
<Actors selectTriggeringEntities="false"><EntityRef entityRef="a"/></Actors><Maneuver name="m">
<Event name="e" priority="overwrite"><Action name="x"><PrivateAction><LateralAction><LaneChangeAction>
<LaneChangeActionDynamics dynamicsShape="sinusoidal" value="1" dynamicsDimension="time"/><LaneChangeTarget>
<RelativeTargetLane entityRef="a" value="-1"/></LaneChangeTarget></LaneChangeAction></LateralAction></PrivateAction>
</Action>
<StartTrigger><ConditionGroup><Condition name="c" delay="0" conditionEdge="none"><ByValueCondition>
<SimulationTimeCondition value="0.5" rule="greaterThan"/></ByValueCondition></Condition></ConditionGroup>
</StartTrigger></Event>
<Event name="f" priority="overwrite"><Action name="y"><PrivateAction><RoutingAction><FollowTrajectoryAction>
<TrajectoryRef>
<Trajectory name="t" closed="false"><Shape><Polyline><Vertex time="0"><Position><WorldPosition x="30" y="0" h="0"/>
</Position></Vertex><Vertex time="1"><Position><WorldPosition x="40" y="1"/></Position></Vertex></Polyline></Shape>
</Trajectory></TrajectoryRef><TimeReference><Timing domainAbsoluteRelative="relative" scale="1" offset="0"/>
</TimeReference>
<TrajectoryFollowingMode followingMode="position"/></FollowTrajectoryAction></RoutingAction></PrivateAction></Action>
<StartTrigger><ConditionGroup><Condition name="c" delay="0" conditionEdge="none"><ByValueCondition>
<SimulationTimeCondition value="2" rule="greaterThan"/></ByValueCondition></Condition></ConditionGroup></StartTrigger>
</Event>
</Maneuver></ManeuverGroup></Act></Story><StopTrigger><ConditionGroup>
<Condition name="c" delay="0" conditionEdge="none">
<ByValueCondition><SimulationTimeCondition value="4" rule="greaterThan"/></ByValueCondition></Condition>
</ConditionGroup>
</StopTrigger></Storyboard></OpenSCENARIO>
"""
ROAD = """<OpenDRIVE><header revMajor="1" revMinor="4"/><road id="7" length="150" junction="-1"><planView>
<geometry s="0" x="0" y="0" hdg="0" length="50"><line/></geometry>
<geometry s="50" x="50" y="0" hdg="0" length="40"><spiral curvStart="0" curvEnd="0.01"/></geometry>
<geometry s="90" x="89.8" y="2.6" hdg="0.2" length="40"><arc curvature="0.01"/></geometry>
<geometry s="130" x="124" y="22" hdg="0.6" length="20">
<paramPoly3 pRange="normalized" aU="0" bU="20" cU="0" dU="0" aV="0" bV="0" cV="1" dV="0"/></geometry></planView>
<elevationProfile><elevation s="0" a="1" b="0.01" c="0" d="0"/></elevationProfile><lanes>
<laneOffset s="0" a="0.5" b="0" c="0" d="0"/><laneSection s="0"><center><lane id="0" type="none"/></center><right>
<lane id="-1" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>
<lane id="-2" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right></laneSection></lanes></road>
</OpenDRIVE>
"""
CALIBRATION = "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"


def foreign_targets(folder: Path) -> list[Target]:
    """Write a small file for every reader; return the readers."""
    return [*_scans(folder / "scans"), *_tracks(folder / "tracks"), *_boxes(folder / "boxes"), *_errors(folder)]


def _scans(root: Path) -> list[Target]:
    cloud = street()[::8].astype("<f4")
    ring = np.arange(len(cloud), dtype="<f4")[:, None] % 32
    names = ("kitti/velodyne", "kitti/label_2", "kitti/calib", "semantic/velodyne", "semantic/labels", "alone")
    kitti, label_2, calib, semantic, labels, alone = (root / name for name in names)
    for made in (kitti, label_2, calib, semantic, labels, alone):
        made.mkdir(parents=True)
    for scan in (alone / "1.bin", kitti / "000001.bin", semantic / "000001.bin"):
        scan.write_bytes(cloud.tobytes())
    (label_2 / "000001.txt").write_text(encode_labels(Boxes.from_array(BOXES[:, :7]), "camera", np.zeros(2, np.int64)))
    (calib / "000001.txt").write_text(CALIBRATION)
    (labels / "000001.label").write_bytes(np.where(np.arange(len(cloud)) % 3, 40, 10).astype("<u4").tobytes())
    (alone / "1.pcd.bin").write_bytes(np.hstack([cloud * [1, 1, 1, 255], ring]).astype("<f4").tobytes())
    np.save(alone / "1.npy", cloud[:40])
    head = "ply\nformat {}\nelement face 0\nproperty list uchar int vertex_indices\nelement vertex 40\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "i")
    )
    (alone / "1.ply").write_bytes(
        f"{head.format('binary_big_endian 1.0')}end_header\n".encode() + cloud[:40].astype(">f4").tobytes()
    )
    rows = "".join(" ".join(map(str, row)) + "\n" for row in cloud[:40].tolist())
    (alone / "2.ply").write_text(f"{head.format('ascii 1.0')}end_header\n{rows}")

    painted, padded = alone / "8.bin", alone / "1.pcd"
    painted.write_bytes(np.hstack([cloud[:40], cloud[:40]]).astype("<f4").tobytes())
    names = "FIELDS x y z _ intensity ring _\nSIZE 4 4 4 1 4 2 1\nTYPE F F F U F U U\nCOUNT 1 1 1 4 1 1 0\n"
    record = np.dtype([("xyz", "<f4", 3), ("_", "u1", 4), ("i", "<f4"), ("ring", "<u2")])
    table = np.zeros(40, record)
    table["xyz"], table["i"] = cloud[:40, :3], cloud[:40, 3]
    place = "WIDTH 10\nHEIGHT 4\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS 40\nDATA binary\n"
    padded.write_bytes(f"VERSION 0.7\n{names}{place}".encode() + table.tobytes() + b"\n")
    words = alone / "columns.txt"
    words.write_text("x,y,z,intensity,_,_,_,_\n255")

    def declared(path: Path) -> object:
        columns, _, scale = path.read_text("utf-8", "replace").partition("\n")
        with tempfile.TemporaryDirectory(dir=root) as made:
            return corrupt_dataset(painted, Path(made) / "8.bin", "fog", columns=columns, intensity_scale=scale)

    def target(name: str, file: Path, scan: Path, corruption: str, kind: str = "text", **options: str) -> Target:
        def read(_: Path) -> object:
            with tempfile.TemporaryDirectory(dir=root) as made:
                return corrupt_dataset(scan, Path(made) / scan.name, corruption, **options)

        return Target(f"scan, {name}", file, read, kind)

    return [
        target("KITTI", alone / "1.bin", alone / "1.bin", "beam_missing", "bytes"),
        target(
            "eight columns",
            painted,
            painted,
            "motion_blur",
            "bytes",
            columns="x,y,z,i,_,_,_,_",
            intensity_scale="waymo",
        ),
        target("PCD of ROS", padded, padded, "noise"),
        Target("scan, --columns and --intensity-scale", words, declared, "text", False),
        target("nuScenes", alone / "1.pcd.bin", alone / "1.pcd.bin", "fog", "bytes"),
        target("numpy", alone / "1.npy", alone / "1.npy", "noise"),
        target("PLY, binary", alone / "1.ply", alone / "1.ply", "snow"),
        target("PLY, ASCII", alone / "2.ply", alone / "2.ply", "crosstalk"),
        target("labels of SemanticKITTI", labels / "000001.label", semantic / "000001.bin", "incomplete_echo", "bytes"),
        target("labels of KITTI", label_2 / "000001.txt", kitti / "000001.bin", "incomplete_echo"),
        target("calibration of KITTI", calib / "000001.txt", kitti / "000001.bin", "incomplete_echo"),
    ]


def _tracks(root: Path) -> list[Target]:
    root.mkdir()
    writers = {
        "street.csv": (write_csv, "text"),
        "street.npz": (write_npz, "arrays"),
        "street.xml": (write_xml, "text"),
    }
    for name, (write, _) in writers.items():
        write(root / name)
    ind, highd, interaction = root / "ind", root / "highd", root / "interaction" / "vehicle_tracks_000.csv"
    for made in (ind, highd, interaction.parent):
        made.mkdir()
    write_interaction(interaction)
    fcd = root / "fcd" / "fcd.xml"
    fcd.parent.mkdir()
    fcd.write_text(FCD)
    types = fcd.with_name("own.rou.xml")
    types.write_text('<routes><vType id="suv" length="4.8" width="1.9" height="1.7" vClass="passenger"/></routes>')
    tables = {path: path for path in (write_ind(ind), write_highd(highd), interaction, fcd)}
    tables |= {
        path.with_name(path.name.replace("tracks", beside)): path for path in list(tables)[:2] for beside in META
    }
    tables[interaction.with_name("pedestrian_tracks_000.csv")] = interaction
    tables[types] = fcd
    cut_in = root / "asam" / "cut_in.xosc"
    cut_in.parent.mkdir()
    cut_in.write_text(CUT_IN)
    roads = cut_in.with_name("road.xodr")
    roads.write_text(ROAD)
    tables |= {cut_in: cut_in, roads: cut_in}

    def recorded(path: Path) -> Callable[[Path], object]:
        return lambda _: record_tracks(path, root / f"of{path.suffix}")

    return [
        *(Target(f"tracks of {name}", root / name, recorded(root / name), kind) for name, (_, kind) in writers.items()),
        *(
            Target(f"tracks, {mutated.relative_to(root)}", mutated, recorded(path), "text")
            for mutated, path in tables.items()
        ),
    ]


def _boxes(root: Path) -> list[Target]:
    truth, found, dumped = root / "truth" / "label_2", root / "found", root / "dumped"
    for made in (truth, found, dumped):
        made.mkdir(parents=True)
    boxes = Boxes.from_array(BOXES[:, :7])
    lines = encode_labels(boxes, "around", np.zeros(2, np.int64))
    (truth / "000003.txt").write_text(lines)
    (found / "000003.txt").write_text("".join(f"{line} 0.8\n" for line in lines.splitlines()))
    listed = root / "boxes.json"
    listed.write_text(json.dumps({"frames": [{"frame": 3, "boxes": BOXES[:, :7].tolist(), "scores": [0.9, 0.5]}]}))
    for name in ("0003_gt.npy", "0003_pred.npy"):
        np.save(dumped / name, boxes.corners())
    return [
        Target("boxes, JSON", listed, lambda path: score(path, truth.parent, "all"), "text"),
        Target("boxes, KITTI", found / "000003.txt", lambda _: score(found, truth.parent, "all"), "text"),
        Target("boxes, true ones of KITTI", truth / "000003.txt", lambda _: score(listed, truth.parent, "all"), "text"),
        Target("boxes, OpenCOOD", dumped / "0003_pred.npy", lambda _: score(dumped, None, "all"), "text"),
    ]


def _errors(root: Path) -> list[Target]:
    path = root / "errors.json"
    errors = fit_errors([sequence(0)], INTERVAL_S)
    model = {"perception": "team", "cooperative": True, "interval_s": INTERVAL_S, "classes": ("car",)}
    write_model(path, ErrorModel(**model, conditions=(errors,)))
    return [Target("error model", path, read_model, "text")]
