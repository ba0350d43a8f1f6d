"""KITTI's labels read: what the writer wrote comes back, and a bad line is one line."""

from pathlib import Path

import numpy as np
import pytest

from dsrc.data.formats.kitti import CAMERA_FROM_LIDAR, encode_labels
from dsrc.data.formats.kitti_labels import calibration_of, label_folder, list_labels, read_labels
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError
from sim.geometry import invert

GOOD = "Car 0.00 0 -1.5 0 0 0 0 1.5 1.8 4.2 2.0 1.6 20.0 0.3"


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.mark.parametrize("scored", [False, True])
def test_boxes_come_back_from_the_labels_they_were_written_as(tmp_path: Path, scored: bool) -> None:
    rng = np.random.default_rng(0)
    array = np.column_stack([rng.uniform(-40, 40, (20, 3)), rng.uniform(1, 8, (20, 3)), rng.uniform(-3, 3, 20)])
    boxes = Boxes.from_array(array, rng.choice([CLASSES.index(name) for name in ("car", "van", "truck")], 20))
    text = encode_labels(boxes, "around", np.zeros(20, np.int64))
    scores = rng.permutation(20) / 20
    if scored:
        text = "".join(f"{line} {score}\n" for line, score in zip(text.splitlines(), scores, strict=True))
    found, score, _ = read_labels(write(tmp_path / "000000.txt", text), CAMERA_FROM_LIDAR, scored)
    np.testing.assert_allclose(found.array, boxes.array, atol=2e-4)
    assert found.label.tolist() == boxes.label.tolist()
    assert score == pytest.approx(scores if scored else np.ones(20))


def test_other_types_and_empty_files_hold_no_vehicle(tmp_path: Path) -> None:
    text = f"{GOOD.replace('Car', 'DontCare')}\n\n{GOOD.replace('Car', 'Pedestrian')}\n{GOOD.replace('Car', 'Bus')}\n"
    assert read_labels(write(tmp_path / "a.txt", text), CAMERA_FROM_LIDAR)[0].label.tolist() == [CLASSES.index("bus")]
    assert len(read_labels(write(tmp_path / "b.txt", ""), CAMERA_FROM_LIDAR, scored=True)[0]) == 0
    # Labels may have scores where none are asked for.
    assert len(read_labels(write(tmp_path / "c.txt", f"{GOOD} 0.5"), CAMERA_FROM_LIDAR)[0]) == 1


def test_a_line_says_where_its_box_is_in_the_image(tmp_path: Path) -> None:
    text = (
        "Van 0.25 2 0 10 20.5 30 61 1.5 1.8 4.2 2.0 1.6 20.0 0.3\nTram 0.9 3 0 0 0 0 9 1.5 1.8 4.2 2.0 1.6 20.0 0.3\n"
    )
    image = read_labels(write(tmp_path / "000000.txt", text), CAMERA_FROM_LIDAR).image
    assert [column.tolist() for column in image] == [[40.5], [2.0], [0.25]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (GOOD, "line 1: expected 16 columns, found 15; the last one is the score"),
        (f"{GOOD} 0.5 1", "line 1: expected 16 columns, found 17"),
        (f"{GOOD} 0.5\n{GOOD} high", "line 2: expected numbers after the type, found Car"),
        (f"{GOOD} nan", "line 1: expected a box of positive size"),
        (f"{GOOD.replace('4.2', '-1')} 0.5", "line 1: expected a box of positive size"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(DataError, match=said):
        read_labels(write(tmp_path / "000000.txt", text), CAMERA_FROM_LIDAR, scored=True)


def test_the_calibration_is_the_frames_own_or_the_nominal_one(tmp_path: Path) -> None:
    labels = tmp_path / "training" / "label_2"
    write(labels / "000007.txt", GOOD)
    write(labels / "readme.txt", "no frame")
    assert label_folder(tmp_path) == label_folder(labels) == labels and label_folder(tmp_path / "else") is None
    assert list_labels(labels) == {7: labels / "000007.txt"}
    assert calibration_of(labels, 7) is CAMERA_FROM_LIDAR
    moved = CAMERA_FROM_LIDAR.copy()
    moved[:3, 3] += [0.1, 0.2, 0.3]
    lines = {"P2": np.zeros((3, 4)), "R0_rect": np.eye(3), "Tr_velo_to_cam": moved[:3]}
    text = "".join(f"{name}: {' '.join(map(str, rows.ravel()))}\n" for name, rows in lines.items())
    calibration = write(labels.parent / "calib" / "000007.txt", text)
    np.testing.assert_allclose(calibration_of(labels, 7), moved)
    here, nominal = (read_labels(labels / "000007.txt", m)[0].center for m in (moved, CAMERA_FROM_LIDAR))
    np.testing.assert_allclose(here - nominal, [invert(moved)[:3, 3] - invert(CAMERA_FROM_LIDAR)[:3, 3]], atol=1e-12)
    write(calibration, text.replace("R0_rect", "R1"))
    with pytest.raises(
        DataError, match=r"000007.txt: R0_rect: expected a line of numbers, as R0_rect or R_rect, found none"
    ):
        calibration_of(labels, 7)
