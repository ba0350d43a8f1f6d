"""Files in the way of a command: only ours are replaced, a device and the input never."""

from collections.abc import Callable
from pathlib import Path

import pytest

from dsrc.__main__ import main
from dsrc.data.write import write_drive
from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import save_detector
from dsrc.training.recipes import debug
from tests.dsrc.data.toy import SETTINGS, ToySource


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A valid drive."""
    folder = tmp_path_factory.mktemp("data") / "toy_3"
    write_drive(folder, SETTINGS, ToySource().open)
    return folder


@pytest.fixture
def detector(tmp_path: Path) -> Path:
    """A detector file."""
    path = tmp_path / "runs" / "detector.pt"
    save_detector(path, Detector(debug().model))
    return path


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Function that runs `dsrc` and returns its one line of error."""

    def run(*args: object) -> str:
        capsys.readouterr()  # what a command before has said
        with pytest.raises(SystemExit) as leaving:
            main([str(arg) for arg in args])
        assert leaving.value.code == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1, lines
        return lines[0]

    return run


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_page_replaces_no_detector_and_no_picture_of_another_program(
    drive: Path, detector: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    content = detector.read_bytes()
    assert "another kind (archive)" in refused("view", drive, "--out", detector)
    assert detector.read_bytes() == content
    photo = tmp_path / "photo.png"
    photo.write_bytes(b"\x89PNG of a cat")
    line = refused("view", drive, "--out", tmp_path / "page.html", "--picture", photo)
    assert "photo.png" in line and "--force" in line
    assert photo.read_bytes() == b"\x89PNG of a cat" and not (tmp_path / "page.html").exists()


def test_a_page_is_written_again_and_with_force_over_anything_regular(
    drive: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    page = tmp_path / "page.html"
    for _ in range(2):
        main(["view", str(drive), "--out", str(page), "--frames", "1"])
    page.write_text("<!doctype html>my own")
    assert "page.html" in refused("view", drive, "--out", page, "--frames", "1")
    main(["view", str(drive), "--out", str(page), "--frames", "1", "--force"])
    assert b"__REVIEW__" in page.read_bytes()


@pytest.mark.parametrize(
    "verb",
    [
        ("generate", "four_way", "--frames", "1", "--out", "{full}", "--seed", "5"),
        ("evaluate", "{drive}", "--checkpoint", "{detector}", "--out", "{full}"),
        ("benchmark", "--checkpoint", "a={detector}", "--data", "{drive}", "--out", "{full}"),
        ("drive", "four_way", "--duration-s", "1", "--out", "{full}"),
        ("dataset", "card", "{drive}", "--out", "{full}"),
        ("demo", "--out", "{full}", "--quick"),
        ("model", "export", "{detector}", "--out", "{full}/results.csv"),
        ("model", "import", "{detector}", "--out", "{full}/results.csv"),
    ],
)
def test_a_folder_of_the_user_is_left_alone(
    verb: tuple[str, ...], drive: Path, detector: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    full = tmp_path / "full"
    folder = full / "four_way_5" if verb[0] == "generate" else full
    folder.mkdir(parents=True)
    (folder / "results.csv").write_text("mine")
    before = tree(full)
    assert "results.csv" in refused(*(word.format(drive=drive, detector=detector, full=full) for word in verb))
    assert tree(full) == before


@pytest.mark.parametrize(
    "verb",
    [
        ("dataset", "render", "{drive}", "--out", "{drive}/rendered"),
        ("dataset", "card", "{drive}", "--out", "{drive}/card"),
        ("evaluate", "{drive}", "--checkpoint", "{detector}", "--out", "{drive}/results"),
        ("model", "train", "debug", "--data", "{drive}", "--out", "{drive}/run"),
        ("view", "{drive}", "--out", "{drive}/1000/000000.pcd"),
    ],
)
def test_nothing_is_written_into_the_input(
    verb: tuple[str, ...], drive: Path, detector: Path, refused: Callable[..., str]
) -> None:
    before = tree(drive)
    assert str(drive) in refused(*(word.format(drive=drive, detector=detector) for word in verb))
    assert tree(drive) == before


def test_no_device_is_replaced(drive: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    device = tmp_path / "device"
    device.symlink_to("/dev/full")
    for verb in (
        ("drive", "four_way", "--duration-s", "1", "--out", device),
        ("view", drive, "--out", device, "--force"),
        ("demo", "--out", device),
    ):
        assert "device" in refused(*verb)
    assert device.is_symlink() and not Path("/dev/full").is_file()
