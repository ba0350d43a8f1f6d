"""Pictures show what the options and the link say together, and an option that would do nothing is refused."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsrc.cli.view import View
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.review.model import ReviewModel
from dsrc.review.page.link import read_link
from dsrc.review.state import ReviewState
from sim.errors import SettingsError
from tests.dsrc.review.conftest import street_frame


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    for name, count in (("a", 3), ("b", 2)):
        for index in range(count):
            write_frame(root / name, replace(street_frame(index), index=index))
    return root


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[tuple]:
    """What is drawn, in place of its drawing: states and rows."""
    seen: list[tuple] = []

    def pictures(
        model: ReviewModel,
        link: str,
        size: tuple[int, int],
        frames: Sequence[int] | None = None,
        start: ReviewState | None = None,
    ) -> Iterator[np.ndarray]:
        state, _, _ = read_link(link, model, start)
        seen.append((state, frames))
        for _ in frames or [state.frame]:
            yield np.zeros((size[1], size[0], 3), np.uint8)

    def picture(model: ReviewModel, link: str, size: tuple[int, int], start: ReviewState) -> np.ndarray:
        return next(pictures(model, link, size, start=start))

    monkeypatch.setattr("dsrc.review.page.output.export.export_pictures", pictures)
    monkeypatch.setattr("dsrc.review.page.output.export.picture", picture)
    return seen


def test_a_picture_shows_what_options_and_link_say(data: Path, drawn: list[tuple], tmp_path: Path) -> None:
    out = {"picture": tmp_path / "p.png", "animation": tmp_path / "a.gif"}
    View(data=data, frame=1, corruption="fog", severity=4, corrupted_agents="ego", link="iou=0.7", **out).run()
    for state, _ in drawn:
        assert (state.frame, state.corruption, state.severity, state.iou) == (1, "fog", 4, 0.7)
        assert state.corrupted_agents == "ego"
    assert list(drawn[1][1]) == [1, 2], "an animation begins at the frame that was asked for"
    View(data=data, severity=4, link="drive=b&frame=1&corruption=fog", picture=tmp_path / "p.png").run()
    state, _ = drawn[-1]
    assert (state.drive, state.frame, state.corruption, state.severity) == (1, 1, "fog", 4)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"out": "page.html", "frame": 2, "link": "frame=1"}, "the link says otherwise; leave out --frame"),
        ({"out": "page.html", "port": 8080}, "it is written without a server; leave out --port"),
        ({"out": "page.html", "size": (640, 480)}, "--size is of pictures; add --picture"),
        ({"out": "page.html", "severity": 4}, "--severity says how sensors are corrupted; add --corruption"),
        ({"link": "frame=1"}, "--link says what is written; add --out"),
        ({"frames": 7}, "--frames is of pages and animations; add --out"),
        ({"picture": "p.png", "frames": 7}, "--frames is of pages and animations; add --out"),
        ({"picture": "p.png", "host": "0.0.0.0"}, "it is written without a server; leave out --host"),
        (
            {"picture": "p.png", "corrupted_agents": "ego"},
            "--corrupted-agents says how sensors are corrupted; add --corruption",
        ),
        ({"picture": "p.png", "frame": 2, "link": "frame=1"}, "the link says otherwise; leave out --frame"),
        ({"picture": "p.png", "frame": 2, "link": "drive=b"}, "the link says otherwise; leave out --frame"),
        ({"picture": "p.png", "frame": 3}, "frame: expected 0 to 2, found 3"),
        ({"picture": "p.png", "corruption": "fog", "severity": 9}, "severity"),
        ({"picture": "p.png", "link": "frame=9"}, "link: frame: expected 0 to 2, found 9"),
        ({"picture": "p.png", "link": "object=77777"}, "link: object: expected one of the objects of a, found 77777"),
        ({"out": "page.html", "link": "object=77777"}, "link: object: expected one of the objects of a, found 77777"),
        ({"out": "page.html", "link": "detection=999"}, "link: detection: expected none, .* in frame 0, found 999"),
        ({"picture": "p.jpg"}, "picture: expected a file that ends with .png, found .*p.jpg"),
        ({"animation": "a.mp4"}, "animation: expected a file that ends with .gif, found .*a.mp4"),
    ],
)
def test_what_would_do_nothing_is_refused(
    data: Path, drawn: list[tuple], tmp_path: Path, options: dict[str, Any], told: str
) -> None:
    paths = {name: tmp_path / options[name] for name in ("out", "picture", "animation") if name in options}
    with pytest.raises(SettingsError, match=told):
        View(data=data, **{**options, **paths}).run()
    assert not drawn and not list(tmp_path.iterdir())
