"""Files of ours as tools of others read them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dsrc.data.datasets.convert import Format, convert
from dsrc.data.write import write_drive
from tests.dsrc.data.toy import SETTINGS, ToySource
from tests.paths import ROOT

FAKE_LOADER = '''
"""A loader with the interface of OpenCOOD's, by the rules of tests/dsrc/data/loaders.py."""
from pathlib import Path

import numpy as np
from matplotlib import cm

from tests.dsrc.data.loaders import opv2v

COLORS, FAR = cm.get_cmap("viridis").colors, np.Inf  # as code of before matplotlib 3.11 and numpy 2 has it


class BaseDataset:
    def __init__(self, params, visualize, train):
        self.samples = opv2v(Path(params["validate_dir"]))

    def __len__(self):
        return len(self.samples)

    def retrieve_base_data(self, index):
        agents = self.samples[index]["agents"]
        poses = {name: one["world_from_lidar"] for name, one in agents.items()}
        ego = next(iter(agents))
        return {
            str(name): {
                "ego": name == ego,
                "lidar_np": one["points"] + np.float32(SHIFT_M),
                "params": {
                    "transformation_matrix": np.linalg.inv(poses[ego]) @ poses[name],
                    "vehicles": {
                        number: {"location": pose[:3, 3], "center": [0.0, 0.0, 0.0], "extent": half}
                        for number, (pose, half) in one["boxes"].items()
                    },
                },
            }
            for name, one in agents.items()
        }
'''


@pytest.mark.parametrize(("shift_m", "code"), [(0.0, 0), (0.001, 1)])
def test_what_a_loader_of_others_reads_is_compared(tmp_path: Path, shift_m: float, code: int) -> None:
    for name in ("one", "two"):
        write_drive(tmp_path / "test" / name, SETTINGS, ToySource().open)
    module = tmp_path / "checkout/opencood/data_utils/datasets/basedataset.py"
    module.parent.mkdir(parents=True)
    module.write_text(f"SHIFT_M = {shift_m}\n{FAKE_LOADER}")
    words = ["studies.readers.opencood", tmp_path / "test", "--opencood", tmp_path / "checkout"]
    done = subprocess.run(
        [sys.executable, "-m", *map(str, words)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == code, done.stderr
    assert ("sweeps of other points" in done.stdout) == bool(code)
    assert "centres of boxes, m" in done.stdout


FAKE_COALIGN = '''
"""A loader with the interface of CoAlign's, by the rules of tests/dsrc/data/loaders.py."""
import json
from pathlib import Path

from tests.dsrc.data.loaders import dair


class DAIRV2XBaseDataset:
    def __init__(self, params, visualize, train):
        self.root = Path(params["data_dir"])
        self.split_info = json.loads(Path(params["validate_dir"]).read_text())

    def __len__(self):
        return len(self.split_info)

    def retrieve_base_data(self, number):
        sample = dair(self.root, [self.split_info[number]])[0]
        pairs = json.loads((self.root / "cooperative/data_info.json").read_text())
        (path,) = (p["cooperative_label_path"] for p in pairs if sample["frame"] in p["vehicle_image_path"])
        sides = [{"lidar_np": a["points"], "params": {"lidar_pose": a["world_from_lidar"]}} for a in sample["agents"]]
        sides[0]["params"]["vehicles_all"] = json.loads((self.root / path).read_text())
        return dict(enumerate(sides))
'''


FAKE_PCDET = '''
"""Objects and calibrations with the interface of OpenPCDet's."""
from types import SimpleNamespace

import numpy as np


def get_objects_from_label(path):
    rows = [[float(value) for value in line.split()[1:]] for line in path.read_text().splitlines()]
    return [SimpleNamespace(h=r[7], w=r[8], l=r[9], loc=np.array(r[10:13]), ry=r[13]) for r in rows]


class Calibration:
    def __init__(self, path):
        rows = dict(line.split(":") for line in path.read_text().splitlines())
        self.turn = np.array(rows["Tr_velo_to_cam"].split(), float).reshape(3, 4)

    def rect_to_lidar(self, points):
        return (points - self.turn[:, 3]) @ self.turn[:, :3]
'''


@pytest.mark.parametrize("kind", ["dair", "kitti", "mcap"])
def test_what_tools_of_others_read_of_a_conversion_is_compared(tmp_path: Path, kind: Format) -> None:
    source, out, checkout = tmp_path / "data/test", tmp_path / "converted", tmp_path / "checkout"
    write_drive(source / "one", SETTINGS, ToySource().open)
    if kind == "mcap":
        pytest.importorskip("mcap.reader")
    convert(source, out, kind, **({"agent_id": "all", "view": "around"} if kind == "kitti" else {}))
    modules = {
        "opencood/data_utils/datasets/basedataset/dairv2x_basedataset.py": FAKE_COALIGN,
        "opencood/utils/transformation_utils.py": "def x_to_world(pose):\n    return pose\n",
        "pcdet/utils/object3d_kitti.py": FAKE_PCDET,
        "pcdet/utils/calibration_kitti.py": FAKE_PCDET,
    }
    for name, text in modules.items():
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        (checkout / name).write_text(text)
    words = {
        "dair": ["coalign", out / "cooperative-vehicle-infrastructure", "--coalign", checkout],
        "kitti": ["kitti", out, "--source", source, "--openpcdet", checkout],
        "mcap": ["mcap", out, "--source", source],
    }[kind]
    command = [sys.executable, "-m", f"studies.readers.{words[0]}", *words[1:]]
    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    counts = dict(line.rsplit(maxsplit=1) for line in done.stdout.splitlines())
    assert float(counts["points"]) > 100 and float(counts["boxes"]) > 5
