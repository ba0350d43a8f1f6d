from dsrc.evaluation.benchmark import Method, run_benchmark
from sensors.corruptions import PAPER_SIX
from tests.dsrc.evaluation.fakes import PointCounter, write_drives


def test_the_six_corruptions_have_a_row_each_and_one_truth(tmp_path):
    drives = write_drives(tmp_path, drives=1, frames=1)
    runs = [run_benchmark([Method("a", PointCounter())], drives, seed=2) for _ in range(2)]
    conditions = [row.condition for row in runs[0]]
    assert conditions == ["clean", *PAPER_SIX, "mean_ap", "mce"]
    assert len({row.truth for row in runs[0]}) == 1
    assert runs[0] == runs[1]
