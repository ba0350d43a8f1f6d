"""Scores of boxes from files: the same boxes give the same numbers, whatever form they come in."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsrc.__main__ import main
from dsrc.cli.evaluate import Score as Command
from dsrc.data.datasets.convert import convert
from dsrc.data.drives import open_drive
from dsrc.data.formats.kitti import encode_labels
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.evaluation.evaluate import evaluate_drives
from dsrc.evaluation.metrics.protocols import PROTOCOLS
from dsrc.evaluation.results import Row
from dsrc.evaluation.scoring.frames import FrameKey
from dsrc.evaluation.scoring.report import score_table, score_tables
from dsrc.evaluation.scoring.score import Score, score
from dsrc.evaluation.scoring.truth import read_truth
from dsrc.ops.detections import Detections
from dsrc.options.detection import Evaluation
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError
from tests.dsrc.data.toy import toy_frame
from tests.dsrc.evaluation.metrics.test_ap import golden_frames
from tests.dsrc.evaluation.metrics.test_protocols import UNRATED
from tests.dsrc.evaluation.small import write_detector, write_drives

FRAMES = 3


def found_in(boxes: Boxes, seed: int) -> Detections:
    """Detections near true boxes, some of them far from any."""
    rng = np.random.default_rng(seed)
    kept = boxes.array[rng.random(len(boxes)) < 0.8]
    array = np.concatenate([kept + rng.normal(0, [0.3, 0.2, 0.1, 0.2, 0.1, 0.1, 0.05], kept.shape), kept[:1]])
    array[-1, 0] += 15.0
    order = np.sort(rng.permutation(100)[: len(array)])[::-1] / 100
    return Detections(Boxes.from_array(array), order.astype(np.float32))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[FrameKey, Detections]]:
    """One drive, and detections in its frames."""
    root = tmp_path_factory.mktemp("score")
    for index in range(FRAMES):
        write_frame(root / "data" / "one", toy_frame(index, seed=1))
    keys = [FrameKey("one", index) for index in range(FRAMES)]
    truth = read_truth(root / "data", keys)
    return root, {key: found_in(truth[key].boxes, key.frame) for key in keys}


def as_json(path: Path, frames: dict[FrameKey, Detections]) -> Path:
    listed = [
        {
            "drive": key.drive,
            "frame": key.frame,
            "boxes": found.boxes.array.tolist(),
            "score": [float(score) for score in found.score],
        }
        for key, found in frames.items()
    ]
    path.write_text(json.dumps({"frames": listed}))
    return path


def as_kitti(folder: Path, frames: dict[FrameKey, Detections]) -> Path:
    folder.mkdir(parents=True)
    for key, found in frames.items():
        lines = encode_labels(found.boxes, "around", np.zeros(len(found), np.int64)).splitlines()
        text = "".join(f"{line} {score:.6f}\n" for line, score in zip(lines, found.score, strict=True))
        (folder / f"{key.frame:06d}.txt").write_text(text)
    return folder


def numbers(scores: Sequence[Score]) -> dict[tuple, float]:
    return {(one.protocol.name, *key): value for one in scores for key, value in one.ap.items()}


def test_json_kitti_and_memory_score_alike(world: tuple[Path, dict[FrameKey, Detections]]) -> None:
    root, frames = world
    by_json = score(as_json(root / "boxes.json", frames), root / "data", "all")
    assert [(one.name, one.protocol.name) for one in by_json] == [("boxes", name) for name in UNRATED]
    assert len({round(one.ap["bev", 0.5], 6) for one in by_json}) > 3  # one detector, several numbers
    for folder in (root / "one_folder", root / "by_drive" / "one"):
        as_kitti(folder, frames)
    for folder in (root / "one_folder", root / "by_drive"):
        by_kitti = score(folder, str(root / "data"), "all")
        assert numbers(by_kitti) == pytest.approx(numbers(by_json))
        assert [one.truth for one in by_kitti] == [one.truth for one in by_json]
    truth = read_truth(root / "data", frames)
    # In memory, the ego's own box is the one around the origin; agents' reach is not known.
    in_memory = score(list(frames.values()), [truth[key].boxes for key in frames], ["opencood", "opencood-no-ego"])
    assert numbers(in_memory).items() <= numbers(by_json).items()
    own = sum(int(truth[key].own.sum()) for key in frames)
    assert in_memory[0].truth - in_memory[1].truth == own > 0


def test_dumped_corners_score_as_opencood_scored_them(tmp_path: Path) -> None:
    golden, frames = golden_frames()
    for i in range(len(frames)):
        best = np.argsort(-golden[f"score/{i}"], kind="stable")
        np.save(tmp_path / f"{i:04d}_pred.npy", golden[f"det/{i}"][best])
        np.save(tmp_path / f"{i:04d}_gt{'_test' if i % 2 else ''}.npy", golden[f"gt/{i}"])
        np.save(tmp_path / f"{i:04d}_pcd.npy", np.zeros((4, 4), np.float32))
    in_memory = {
        one.protocol.name: one for one in score([f.detections for f in frames], [f.truth for f in frames], "all")
    }
    for one in score(tmp_path, None, "all"):
        if one.protocol.order == "frame":
            assert one.ap == pytest.approx(in_memory[one.protocol.name].ap, rel=1e-12)
        else:  # the files have no scores
            assert all(map(math.isnan, one.ap.values())) and "no scores" in one.note
        assert (one.truth, one.detections) == (
            in_memory[one.protocol.name].truth,
            in_memory[one.protocol.name].detections,
        )
    with pytest.raises(SettingsError, match=r"score_threshold: expected none for boxes without scores, found 0\.3$"):
        score(tmp_path, None, "all", score_threshold=0.3)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> tuple[Evaluation, dict[tuple[str, str], Row]]:
    root = tmp_path_factory.mktemp("stored")
    write_drives(root / "test", drives=2)
    checkpoint = f"DSRC={write_detector(root / 'dsrc.pt', 'dsrc')}"
    config = Evaluation(checkpoint=(checkpoint,), data=root / "test", out=root / "out", corruption=("fog",))
    return config, {(row.method, row.condition): row for row in evaluate_drives(config)}


def test_stored_results_score_what_their_evaluation_says(stored: tuple[Evaluation, dict[tuple[str, str], Row]]) -> None:
    config, rows = stored
    found = score(config.out, protocol=["testbed", "testbed-per-frame"])
    assert {one.name for one in found} == {"DSRC", "DSRC, ego alone"}
    for one in found:
        row = rows[one.name, "clean"]
        for (space, threshold), value in one.ap.items():
            sort = "ap_opencood" if one.protocol.order == "frame" else "ap"
            assert value == row.metrics[f"{sort}_{space}_{round(100 * threshold)}"]
        assert (one.frames, one.truth, one.detections) == (row.frames, row.truth, row.detections)
        assert one.note.startswith("detections stored within x ")
    # The tree has more true boxes than the range of the detector, and these are missed.
    by_tree = score(config.out, config.data, "testbed")
    assert all(a.truth >= b.truth and a.detections == b.detections for a, b in zip(by_tree, found[::2], strict=True))
    names = {one.name for one in score(config.out / "detections.json", protocol="testbed", corruption="all")}
    assert names == {"DSRC", "DSRC, ego alone", "DSRC, fog 3", "DSRC, ego alone, fog 3"}
    with pytest.raises(SettingsError, match="corruption: expected one that is stored, found fogg; did you mean 'fog'"):
        score(config.out, corruption="fogg")


def test_the_command_writes_tables_with_the_card_beside_each_number(
    world: tuple[Path, dict[FrameKey, Detections]], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    root, frames = world
    boxes = as_json(root / "again.json", frames)
    for _ in range(2):  # its own files may be replaced
        Command(detections=boxes, truth=root / "data", out=tmp_path / "scores").run()
    printed = capsys.readouterr().out
    assert "opencood-global" in printed and f"{tmp_path / 'scores'}\n" in printed
    written = json.loads((tmp_path / "scores" / "scores.json").read_text())
    assert written["provenance"]["data"] == {"one": open_drive(root / "data" / "one").digest()}
    for row in written["rows"]:
        protocol = PROTOCOLS[row["protocol"]]
        assert (row["counted"], row["source"]) == (protocol.card, protocol.source)
    head, *lines = (tmp_path / "scores" / "scores.csv").read_text().splitlines()[1:]
    assert head.startswith("detections,protocol,ap_bev_30") and len(lines) == len(UNRATED)
    assert PROTOCOLS["kitti-r40"].card in (tmp_path / "scores" / "scores.md").read_text()
    assert (tmp_path / "scores" / "scores.png").stat().st_size > 10_000


def test_a_threshold_leaves_out_what_is_below_it(
    world: tuple[Path, dict[FrameKey, Detections]], tmp_path: Path
) -> None:
    root, frames = world
    least = float(np.median(np.concatenate([found.score for found in frames.values()])))
    kept = {key: found[found.score >= least] for key, found in frames.items()}
    assert 0 < sum(map(len, kept.values())) < sum(map(len, frames.values()))
    whole = as_json(tmp_path / "boxes.json", frames), root / "data", "all"
    known = score(as_json(tmp_path / "kept.json", kept), root / "data", "all")
    assert numbers(score(*whole, score_threshold=least)) == numbers(known) != numbers(score(*whole))


def test_a_threshold_leaves_out_boxes_in_the_image_too(tmp_path: Path) -> None:
    write_frame(tmp_path / "data" / "one", toy_frame(0))
    tree = convert(tmp_path / "data", tmp_path / "kitti", "kitti", view="around")
    lines = (tree / "training/label_2/000000.txt").read_text().splitlines()
    for name, kept in (("all", lines), ("kept", lines[:1])):
        (tmp_path / name).mkdir()
        scored = (f"{line} {1.0 - 0.5 * place}\n" for place, line in enumerate(kept))
        (tmp_path / name / "000000.txt").write_text("".join(scored))
    found, known = score(tmp_path / "all", tree, "all", score_threshold=0.9), score(tmp_path / "kept", tree, "all")
    assert len(known) > len(UNRATED) and len(lines) > 1
    assert [(one.protocol.name, one.detections) for one in found] == [
        (one.protocol.name, one.detections) for one in known
    ]
    assert numbers(found) == pytest.approx(numbers(known), nan_ok=True)
    assert all(one.note == "boxes from a score of 0.9 on" for one in found)


def test_the_command_refuses_in_one_line(
    world: tuple[Path, dict[FrameKey, Detections]], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    root, frames = world
    boxes, data = str(as_json(tmp_path / "boxes.json", frames)), str(root / "data")
    one = as_kitti(tmp_path / "kitti", frames) / "000000.txt"
    for words, said in (
        (["nowhere"], "nowhere: no such file or folder of detections"),
        ([boxes], f"{boxes}: truth: expected a tree of true boxes"),
        (
            [boxes, "--truth", data, "--protocol", "kitti"],
            "score: protocol: expected the name of a protocol, found kitti",
        ),
        ([boxes, "--truth", data, "--out", boxes], f"{boxes}: output: expected a folder, found a file"),
        ([boxes, "--truth", data, "--score-threshold", "nan"], "score: score_threshold: expected a number, found nan"),
        ([str(one)], f"{one}: detections: expected the folder of such files, found one of them"),
        (
            [boxes, "--truth", data, "--protocol", "kitti-easy-r40"],
            "protocol kitti-easy-r40: expected KITTI's label files with boxes in the image",
        ),
    ):
        with pytest.raises(SystemExit) as leaving:
            main(["score", *words])
        assert leaving.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line


def test_several_sets_share_a_table() -> None:
    _, frames = golden_frames()
    found = score([f.detections for f in frames], [f.truth for f in frames], "opencood")
    several = [*found, replace(found[0], name="other", note="half of it")]
    text = score_table(several).markdown()
    assert "| other | opencood |" in text and text.rstrip().endswith("other: half of it.")
    first, last = score_tables(several)
    assert not first.caption and last.caption.startswith("opencood: ") and last.caption.endswith("other: half of it.")


def test_boxes_of_another_data_set_are_doubted(world: tuple[Path, dict[FrameKey, Detections]]) -> None:
    _, frames = world
    own = [Boxes.from_array(np.repeat(found.boxes.array, 4, axis=0)) for found in frames.values()]
    assert len(own[0]) * FRAMES >= 20
    elsewhere = [boxes.array + np.array([200.0, 0, 0, 0, 0, 0, 0]) for boxes in own]
    scores = [np.linspace(0.9, 0.1, len(boxes), dtype=np.float32) for boxes in own]
    near, far = (
        score([Detections(Boxes.from_array(a), s) for a, s in zip(arrays, scores, strict=True)], own, "opencood")[0]
        for arrays in ([boxes.array for boxes in own], elsewhere)
    )
    assert near.note == "" and "0 of" in far.note and "data set" in far.note


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('{"frames": [{"frame": 0, "boxes": [[1,2,3]], "scores": [1]}]}', "boxes"),
        (
            '{"frames": [{"frame": 0, "boxes": [], "scores": [1]}]}',
            r"score: expected one for each of 0 boxes, found 1",
        ),
        (
            '{"frames": [{"frame": 0, "boxes": [[1,2,3,4,5,6,0],[1,2,3,4,5,6,-90]], "score": [1,1]}]}',
            r"frames\[0\].boxes: expected radians within 2 pi, found -90 in row 1",
        ),
        ('{"frames": [{"frame": 0, "boxes": [[1,2,3,0,5,6,7]], "scores": [1]}]}', "expected positive sizes, found 0 m"),
        ('{"frames": [{"frame": 0, "boxes": [], "scores": []}, {"frame": 0, "boxes": [], "scores": []}]}', "again"),
        ('{"frames": [{"frame": 0, "box": []}]}', "box"),
        ('{"frames": []}', "frames: expected at least one, found none"),
        ('{"frames": [{"frame": 0, "boxes": [[1e300,2,3,4,5,6,7]], "scores": [1]}]}', "1e7|10000000"),
        ('{"frames": [{"frame": 0, "boxes": [["nan",2,3,4,5,6,7]], "scores": [1]}]}', r"boxes\[0\]"),
        ("{", "JSON"),
    ],
)
def test_a_wrong_json_is_one_line(tmp_path: Path, content: str, said: str) -> None:
    path = tmp_path / "boxes.json"
    path.write_text(content)
    with pytest.raises(DataError, match=said) as caught:
        score(path, tmp_path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_what_is_no_detection_is_one_line(world: tuple[Path, dict[FrameKey, Detections]], tmp_path: Path) -> None:
    _, frames = world
    with pytest.raises(DataError, match="nowhere: no such file or folder"):
        score(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"detections: expected detections.json, a JSON file, label files"):
        score(tmp_path)
    with pytest.raises(DataError, match="truth: expected a tree of true boxes, since none are stored here"):
        score(as_json(tmp_path / "boxes.json", frames))
    (tmp_path / "label_2").mkdir()
    (tmp_path / "label_2" / "000000.txt").write_text("")
    (tmp_path / "one.json").write_text('{"frames": [{"frame": 0, "boxes": [], "scores": []}]}')
    with pytest.raises(DataError, match=r"label_2: truth: expected true boxes in the frames of .*one.json, found none"):
        score(tmp_path / "one.json", tmp_path / "label_2")
    with pytest.raises(DataError, match="detections: truth: expected the true boxes of each frame, found 0 of 3"):
        score(list(frames.values()), [])
    np.save(tmp_path / "0000_pred.npy", np.zeros((2, 8, 3)))
    with pytest.raises(DataError, match=r"0000_gt.npy: expected true boxes beside 0000_pred.npy, found none"):
        score(tmp_path)
    np.save(tmp_path / "0000_gt.npy", np.zeros((2, 4, 2)))
    with pytest.raises(DataError, match=r"0000_gt.npy: array: expected floats of shape \(n, 8, 3\), found float64 of"):
        score(tmp_path)
    np.save(tmp_path / "0000_gt.npy", np.full((2, 8, 3), np.nan))
    with pytest.raises(DataError, match=r"0000_gt.npy: array: expected numbers up to 1e\+07, found NaN or larger ones"):
        score(tmp_path)
    np.save(tmp_path / "0000_gt.npy", np.array([object()]), allow_pickle=True)
    with pytest.raises(
        DataError, match=r"0000_gt.npy: not a readable array of corners: Object arrays cannot be loaded"
    ):
        score(tmp_path)
