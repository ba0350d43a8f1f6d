"""A training: two frames of a drive, a small network, and what it finds in them afterwards.

Usage:
    python examples/09_train.py --epochs 40
"""

import argparse
import tempfile
from pathlib import Path

import dsrc
from dsrc.training.train import train_stages


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="four_way")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--epochs", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        data, out = Path(folder) / "data", Path(folder) / "run"
        drive = dsrc.generate(options.scenario, data / "drive", options.frames, seed=1, visibility=False)
        # As `dsrc model train debug --method attfuse --stage plain` does.
        file = train_stages(recipe="debug", method="attfuse", stage="plain", data=data, out=out, epochs=options.epochs)
        print((file.parent / "metrics.csv").read_text().strip())
        frame = dsrc.open_drive(drive).read(0)
        found = dsrc.detect(dsrc.load_detector(file), frame)
        print(f"{len(found)} boxes above the score threshold, of {len(frame.truth)} road users")


if __name__ == "__main__":
    main()
