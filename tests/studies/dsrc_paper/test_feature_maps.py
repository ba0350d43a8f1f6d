"""What the features of a network tell."""

from pathlib import Path

import msgspec
import torch

from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import save_detector
from tests.commands import study
from tests.dsrc.evaluation.small import make_detector, write_detector, write_drives


def test_a_head_that_always_says_one_direction_is_right_where_the_other_guess_is_wrong(tmp_path: Path) -> None:
    """Its other heads say the same everywhere, too: no cell holds a vehicle, whatever the points."""
    for split in ("train", "validation", "test"):
        write_drives(tmp_path / "data" / split)
    detector = Detector(msgspec.structs.replace(make_detector("attfuse").settings, direction=True))
    for head, says in ((detector.direction_head, 1.0), (detector.cls_head, -30.0)):
        torch.nn.init.zeros_(head.weight)
        torch.nn.init.constant_(head.bias, says)
    save_detector(tmp_path / "headed.pt", detector, {})
    other = write_detector(tmp_path / "other.pt", "attfuse")
    script, files = "dsrc_paper.feature_maps", (str(tmp_path / "headed.pt"), f"without={other}")
    printed = study(script, "--data", str(tmp_path / "data"), "--checkpoint", *files, "--frames", "4", "--tested", "4")
    rows = [line.strip("| ").split(" | ") for line in printed.splitlines()]
    shares = {row[1]: list(map(int, row[2:])) for row in rows[2:6]}
    assert {row[0] for row in rows[2:6]} == {"headed"}
    assert [a + b for a, b in zip(*list(shares.values())[:2], strict=True)] == [100, 100]
    assert all(0 <= share <= 100 for two in shares.values() for share in two)
    frames, below, share, boxes, inside, least, without = rows[8][1:]
    assert (frames, below, share, boxes, least, without) == ("4", "4", "100.00", inside, "-30", "-30")
    assert int(boxes) > 0
    assert rows[9][0] == "without" and rows[9][4] == boxes and rows[9][5] == "0"
