"""Trainings for `torchrun`: python -m tests.dsrc.training.shared_batch DATA OUT [cut]."""

import sys
from pathlib import Path

from dsrc.training.train import train
from tests.dsrc.training.runs import Power, StillNorms, tiny

RECIPE = tiny(epochs=2, validate_every=1, batch_size=2, validation_share=0.4, half=False)

if __name__ == "__main__":
    data, out = Path(sys.argv[1]), Path(sys.argv[2])
    cut = [Power(1)] if sys.argv[3:] == ["cut"] else []
    train(RECIPE, data, out, "plain", seed=1, callbacks=[StillNorms(), *cut])
    teacher = train(RECIPE, data, out / "teacher", "teacher")
    train(RECIPE, data, out / "student", "student", teacher=teacher)
