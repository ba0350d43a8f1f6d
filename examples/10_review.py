"""A review page of your own drive: points, true boxes and what a detector finds, in one HTML file.

Usage:
    python examples/10_review.py --out page.html --corruption fog
"""

import argparse
import tempfile
from pathlib import Path

import dsrc

DETECTOR = Path(__file__).parents[1] / "dsrc/checkpoints/small-dsrc.pt"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="four_way")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--corruption", default="clean")
    parser.add_argument("--out", type=Path, default=Path("page.html"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        drive = dsrc.generate(options.scenario, Path(folder) / "drive", options.frames, seed=2)
        page = dsrc.export_html(drive, options.out, checkpoint=DETECTOR, corruption=options.corruption)
    print(f"{page}: {page.stat().st_size / 1e6:.1f} MB, opens in any browser")


if __name__ == "__main__":
    main()
