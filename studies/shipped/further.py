"""Detector for real roads, trained further on uneven and level drives, and the mean of its weights before and after.

Networks that have seen no level, bare world lose points there; more steps on such frames win them back, and cost false
boxes on real roads. The mean of the weights (WiSE-FT, Wortsman et al., CVPR 2022) lies between them in both. Another
`--share` trains nothing anew. The data: `dsrc dataset build studies/shipped/further.toml --out data/further`.

Usage:
    python -m studies.shipped.further --data data/further --out runs/further
"""

import argparse
import time
from pathlib import Path

from dsrc.models.storage.checkpoint import load_detector, read_meta, save_detector
from dsrc.training.train import train
from studies.shipped.train import BATCH, STARTS, Run

START = Path("dsrc/checkpoints/road-dsrc-alone.pt")
FRAMES = 200
"""Frames of an epoch, drawn anew for each."""


def further(steps: int) -> Run:
    """Return the training, validated on the ends of its own drives."""
    epochs = max(BATCH * steps // FRAMES, 1)
    size = (f"epochs={epochs}", f"epoch_frames={FRAMES}", "validate_every=2")
    return Run("further", "dsrc-alone", "student", START.stem, steps, 5e-4, "parked-teacher", settings=size)


def mean(first: Path, second: Path, share: float, out: Path) -> None:
    """Write a detector whose weights lie between those of two of one form; its record is the second's.

    Args:
        share: of the second's weights, 0 to 1.
    """
    detector, after = load_detector(first), load_detector(second).state_dict()
    before = detector.state_dict()
    between = {name: (value + share * (after[name] - value)).to(value.dtype) for name, value in before.items()}
    detector.load_state_dict(between)
    record = {key: value for key, value in read_meta(second).items() if key != "metrics"}
    save_detector(out, detector, record | {"mean_with": first.name, "share_of_trained": share})


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data/further"), help="folder of the data set")
    parser.add_argument("--out", type=Path, default=Path("runs/further"), help="folder of the run and its mean")
    parser.add_argument("--steps", type=int, default=300, help=f"of {BATCH} frames")
    parser.add_argument("--share", type=float, default=0.5, help="of the new weights in the mean, 0 to 1")
    options = parser.parse_args()
    run, begun = further(options.steps), time.monotonic()
    trained = train(
        run.recipe(),
        options.data / "train",
        options.out / run.name,
        run.stage,
        teacher=STARTS / f"{run.teacher}.pt",
        init=START,
    )
    print(f"{run.name}: {time.monotonic() - begun:.0f} s", flush=True)
    out = options.out / f"{START.stem}.pt"
    mean(START, trained, options.share, out)
    print(out)


if __name__ == "__main__":
    main()
