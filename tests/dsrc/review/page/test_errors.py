"""Errors on the page: the list, its keys, background detection and notes."""

import json
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dsrc.data.sample import Sample
from dsrc.review import palette
from dsrc.review.errors.filters import FP, KINDS
from dsrc.review.errors.notes import NoteBook
from dsrc.review.errors.score_plots import histogram_svg, hits_of
from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.commands import COMMANDS, go_to_error
from dsrc.review.page.panels.legend import LegendPanel
from dsrc.review.page.panels.run.errors import ErrorsPanel
from dsrc.review.page.panels.run.notes import NotesPanel
from dsrc.review.page.server import start_server
from dsrc.review.page.session import Session
from dsrc.review.palette import css, method_color
from sensors.frame import Frame
from sim.errors import DataError, SettingsError
from tests.dsrc.review.conftest import FakeDetector, FakeDrive
from tests.dsrc.review.page.conftest import SocketBrowser
from tests.dsrc.review.page.test_session import panel, wait_for

RUN = {command.label: command.run for command in COMMANDS}


@pytest.fixture
def model(drive: FakeDrive, detector: FakeDetector, tmp_path: Path) -> ReviewModel:
    return ReviewModel([drive], detector, NoteBook(tmp_path / "notes.json"))


def missed(session: Session) -> str | None:
    details = session.wait_drawn().details
    return None if details is None else getattr(details, "verdict", None)


def test_n_goes_to_the_next_missed_object_box_card_and_camera(session: Session, browser: SocketBrowser) -> None:
    RUN["Next missed object"](session)
    state = session.state
    assert state.frame == 0 and state.object_id is not None
    assert missed(session) == "missed"
    place = session.view.selected
    wait_for(lambda: abs(session.client.camera.look_at - place).max() < 1e-3)
    RUN["Next missed object"](session)
    assert session.state.frame == 1 and missed(session) == "missed"
    RUN["Previous missed object"](session)
    assert (session.state.frame, session.state.object_id) == (0, state.object_id)


def test_p_goes_to_false_detections_alone(session: Session) -> None:
    RUN["Next false detection"](session)
    assert session.state.detection is not None and missed(session) == "false"
    first = session.state.frame
    RUN["Next false detection"](session)
    assert session.state.frame == first + 1 and missed(session) == "false"


def test_the_last_one_says_that_there_is_none_after_it(session: Session) -> None:
    session.update(frame=11)
    RUN["Next missed object"](session)
    here = session.state
    RUN["Next missed object"](session)
    assert session.state == here and "No missed object after this one" in session._notice.content
    assert "in the whole run" in session._notice.content


def test_without_any_it_says_so_after_all_frames(session: Session) -> None:
    session.update(threshold=1.0)
    go_to_error(session, 1, "false")
    assert "No false detection after this one" in session._notice.content
    assert session.report(session.state).known == 12, "all frames were looked at"


@pytest.fixture
def presses(
    session: Session, detector: FakeDetector, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str], list[threading.Thread]]]:
    """Press keys that search, each in a thread of its own, while no detection ends."""
    detect, gate, threads = detector.detect, threading.Event(), []
    session.update(threshold=1.0)
    session.wait_drawn()
    monkeypatch.setattr(detector, "detect", lambda sample: gate.wait(20.0) and detect(sample))

    def press(kind: str) -> list[threading.Thread]:
        threads.append(threading.Thread(target=go_to_error, args=(session, 1, kind), daemon=True))
        threads[-1].start()
        return threads

    yield press
    gate.set()
    for thread in threads:
        thread.join(20.0)


def test_a_held_key_searches_once_and_another_key_in_its_place(
    session: Session, presses: Callable[[str], list[threading.Thread]]
) -> None:
    for _ in range(5):
        threads = presses("false")
    wait_for(lambda: sum(thread.is_alive() for thread in threads) == 1, 3.0)
    wait_for(lambda: "Looking for a false detection" in session._notice.content)
    presses("poor")
    wait_for(lambda: "Looking for a poor box" in session._notice.content, 3.0)
    wait_for(lambda: sum(thread.is_alive() for thread in threads) == 1, 3.0)
    session.update(frame=3)
    wait_for(lambda: not any(thread.is_alive() for thread in threads), 3.0)


def test_a_search_ends_with_its_page(
    session: Session, browser: SocketBrowser, presses: Callable[[str], list[threading.Thread]]
) -> None:
    threads = presses("false")
    wait_for(lambda: "Looking for a false detection" in session._notice.content)
    browser.close()
    wait_for(lambda: not threads[0].is_alive(), 3.0)


def test_without_labels_or_detector_it_says_why(truth_model: ReviewModel, connect_browser: type[SocketBrowser]) -> None:
    app = ReviewApp(truth_model, start_server())
    try:
        session = connect_browser(app).session
        session.wait_drawn()
        go_to_error(session, 1)
        assert "nothing is judged" in session._notice.content
        assert not panel(session, ErrorsPanel).folder.visible
    finally:
        app.close()


def test_detecting_in_all_frames_fills_the_list(session: Session) -> None:
    errors = panel(session, ErrorsPanel)
    assert errors.detect.visible and "1 of 12 frames" in errors.progress.content
    session.detect_all()
    wait_for(lambda: "12 of 12 frames" in errors.progress.content and not errors.detect.visible)
    assert not errors.bar.visible
    assert errors.scores.content.count("<tr>") == 2
    listed = session.report(session.state).errors
    assert [button.visible for button in errors.rows] == [row < len(listed) for row in range(len(errors.rows))]
    assert errors.rows[0].label.startswith(f"{listed.row[0]}: {KINDS[listed.kind[0]]}")


def test_drives_of_one_name_detect_for_themselves(
    drive: FakeDrive, detector: FakeDetector, connect_browser: type[SocketBrowser], monkeypatch: pytest.MonkeyPatch
) -> None:
    other = type(drive)(drive=Path("elsewhere/street"))
    app = ReviewApp(ReviewModel([drive, other], detector), start_server())
    try:
        first, second = (connect_browser(app, f"drive={row}").session for row in (0, 1))
        first.wait_drawn(), second.wait_drawn()
        detect, gate = detector.detect, threading.Event()
        monkeypatch.setattr(detector, "detect", lambda sample: gate.wait(10.0) and detect(sample))
        first.detect_all()
        (job,) = first.detecting()
        assert not second.detecting()
        second.cancel()
        gate.set()
        wait_for(lambda: not first.detecting())
        assert job.state == "done" and app.worker.jobs() == []
    finally:
        app.close()


def test_frames_that_cannot_be_detected_in_and_a_detector_that_fails_are_told(
    session: Session, drive: FakeDrive, detector: FakeDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = type(drive).read

    def broken(self: FakeDrive, row: int) -> Frame:
        if row in (8, 9):
            raise DataError(f"{row:06d}.pcd: not a readable point cloud")
        return read(self, row)

    monkeypatch.setattr(type(drive), "read", broken)
    session.detect_all()
    wait_for(lambda: "frame 8 and 1 more: 000008.pcd: not a readable" in session._notice.content.replace("\\", ""))

    def fails(sample: Sample) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(detector, "detect", fails)
    session.update(cooperative=False)
    session.wait_drawn()
    session.detect_all()
    wait_for(lambda: "detecting has ended. frame 0: RuntimeError: out of memory" in session._notice.content)


def test_a_click_on_a_row_shows_its_error_and_the_threshold_writes_the_list_again(session: Session) -> None:
    session.detect_all()
    errors = panel(session, ErrorsPanel)
    wait_for(lambda: "12 of 12 frames" in errors.progress.content)
    table = session.report(session.state).errors
    errors._open(1)
    session.wait_drawn()
    assert session.state.frame == table.row[1]
    chosen = [button.color for button in errors.rows]
    assert chosen[1] != chosen[0] == chosen[2]
    session.update(threshold=0.99)
    session.wait_drawn()
    wait_for(lambda: not any("false" in button.label for button in errors.rows if button.visible))
    assert (session.report(session.state).errors.kind != FP).all()


def test_clean_sweeps_have_no_list_of_what_is_broken(session: Session, fake_fog: list[tuple[int, str, int]]) -> None:
    errors = panel(session, ErrorsPanel)
    session.update(corruption="fog", listed="broken")
    session.wait_drawn()
    wait_for(lambda: "against clean" in errors.progress.content)
    RUN["Clean or corrupted"](session)
    session.wait_drawn()
    wait_for(lambda: "against" not in errors.progress.content and errors._report is not None)
    assert session.state.listed == "all" and errors._report is session.report(session.state)


def test_where_there_is_no_report_nothing_is_left_of_the_one_before(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = panel(session, ErrorsPanel)
    wait_for(lambda: errors.rows[0].visible and errors.plots.content)

    def none(*_: object) -> None:
        raise SettingsError("street: methods: expected a set of detections, found none")

    with monkeypatch.context() as patch:
        patch.setattr(session, "report", none)
        session.update(threshold=0.4)
        session.wait_drawn()
        wait_for(lambda: "found none" in errors.progress.content)
        assert not any(row.visible for row in errors.rows) and not errors.plots.content and errors.csv.disabled
        assert errors.scores.content == "" and len(errors.frames.options) == 1
    session.update(threshold=0.3)
    session.wait_drawn()
    wait_for(lambda: errors.rows[0].visible and errors.plots.content)


def test_a_panel_that_fails_keeps_no_other_from_being_set(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: object) -> None:
        raise RuntimeError("no curve")

    with monkeypatch.context() as patch:
        patch.setattr(panel(session, LegendPanel), "show", fails)
        session.update(object_id=1005)
        session.wait_drawn()
        wait_for(lambda: "no curve" in session._notice.content and panel(session, NotesPanel).folder.visible)


def test_a_note_is_saved_beside_the_run_and_comes_back(session: Session, tmp_path: Path) -> None:
    notes = panel(session, NotesPanel)
    assert not notes.folder.visible
    RUN["Next missed object"](session)
    session.wait_drawn()
    wait_for(lambda: notes.folder.visible)
    notes.text.value, notes.tags.value = "behind the truck", "occluded far"
    notes._save()
    (note,) = json.loads((tmp_path / "notes.json").read_text())["notes"].values()
    assert note == {"text": "behind the truck", "tags": ["occluded", "far"]}
    session.update(object_id=None)
    session.wait_drawn()
    wait_for(lambda: not notes.folder.visible)
    RUN["Next missed object"](session)
    wait_for(lambda: notes.folder.visible and notes.text.value == "behind the truck")


def noting(session: Session, **selection: Any) -> NotesPanel:
    """Panel of the notes once something else is selected."""
    notes = panel(session, NotesPanel)
    session.update(**selection)
    session.wait_drawn()
    wait_for(lambda: notes.folder.visible)
    return notes


def test_browsers_keep_each_others_notes(
    app: ReviewApp, session: Session, connect_browser: type[SocketBrowser]
) -> None:
    other = connect_browser(app).session
    mine, theirs = (noting(one, object_id=1005) for one in (session, other))
    theirs.text.value = "a truck hides it"
    theirs._save()
    mine.tags.value = "far"
    mine._save()
    assert (mine.text.value, mine.tags.value) == ("a truck hides it", "far")
    noting(other, threshold=0.35)
    wait_for(lambda: theirs.tags.value == "far")
    theirs.text.value, mine.text.value = "a bus hides it", "a van hides it"
    theirs._save(), mine._save()
    assert "found 'a bus hides it'" in session._notice.content and mine.text.value == "a van hides it"
    mine._save()
    assert not session._notice.visible
    (note,) = json.loads(session.notes.path.read_text())["notes"].values()
    assert note == {"text": "a van hides it", "tags": ["far"]}


def test_what_is_being_written_is_there_again_with_its_error(session: Session) -> None:
    notes = noting(session, object_id=1005)
    notes.text.value = "half a no"
    session.step(1)
    session.wait_drawn()
    wait_for(lambda: notes.text.value == "")
    notes._save()
    session.step(-1)
    session.wait_drawn()
    wait_for(lambda: notes.text.value == "half a no")
    notes.text.value = "half a note"
    notes._save()
    assert len(session.notes) == 1


def test_notes_are_of_one_drive_one_ego_and_its_cooperation(
    drive: FakeDrive, detector: FakeDetector, tmp_path: Path, connect_browser: type[SocketBrowser]
) -> None:
    other = type(drive)(drive=Path("elsewhere/street"))
    app = ReviewApp(ReviewModel([drive, other], detector, NoteBook(tmp_path)), start_server())
    try:
        session = connect_browser(app).session
        notes = noting(session, object_id=1005)
        notes.text.value = "of the first"
        notes._save()
        (key,) = json.loads((tmp_path / "notes.json").read_text())["notes"]
        assert key == "0: street / frame 0 / detector / clean / ego 1000 / missed / object 1005"
        session.update(cooperative=False)
        session.wait_drawn()
        wait_for(lambda: notes.text.value == "")
        session.update(cooperative=True, ego_id=1000)
        session.wait_drawn()
        wait_for(lambda: notes.text.value == "of the first")
        session.update(drive=1)
        noting(session, object_id=1005)
        wait_for(lambda: notes.text.value == "")
    finally:
        app.close()


def test_the_list_is_saved_with_its_notes(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    monkeypatch.setattr(session.client, "send_file_download", lambda name, content, **_: given.append((name, content)))
    errors = panel(session, ErrorsPanel)
    wait_for(lambda: errors._report is not None)
    errors._save()
    name, content = given[0]
    assert name == "errors.csv" and content.decode().splitlines()[0].startswith("drive,frame,method")
    assert len(content.decode().splitlines()) == 1 + len(session.report(session.state).errors)


def test_in_the_light_theme_nothing_in_the_list_is_dark_and_no_curve_white(session: Session) -> None:
    errors = panel(session, ErrorsPanel)
    for theme in ("light", "dark", "light"):
        session.update(theme=theme)
        session.wait_drawn()
        wait_for(lambda theme=theme: (min(errors.rows[1].color or (0,)) > 200) == (theme == "light"))
    other = [row.color for row in errors.rows if row.visible and row.color != (56, 150, 255)]
    assert other and min(map(min, other)) > 200
    assert f'stroke="{css(method_color(0))}"' in errors.plots.content


def clicked(value: int) -> SimpleNamespace:
    """What the script of the page sends for a click on a plot."""
    return SimpleNamespace(client_id=1, target=SimpleNamespace(value=value))


def test_a_bar_of_the_histogram_goes_through_the_errors_with_its_scores(session: Session) -> None:
    errors = panel(session, ErrorsPanel)
    session.detect_all()
    wait_for(lambda: errors._report is not None and errors._report.known == 12)
    seen = set()
    for _ in range(12):
        errors._to_bin(clicked(8))
        details = session.wait_drawn().details
        assert details.verdict == "false" and details.score == pytest.approx(0.4)
        seen.add(session.state.frame)
    assert len(seen) == 12, "each click goes on to the next one"
    errors._to_bin(clicked(1))
    assert "No listed error has a score of 0.05 to 0.10" in session._notice.content


def test_a_place_of_the_curve_sets_the_threshold_that_has_its_recall(session: Session) -> None:
    errors = panel(session, ErrorsPanel)
    # In the one known frame four of five objects are found, with scores of 0.9, 0.8, 0.7 and 0.6.
    for recall, score in ((40, 0.8), (0, 0.9), (61, 0.6), (80, 0.6)):
        errors._to_recall(clicked(recall))
        view = session.wait_drawn()
        assert session.state.threshold == pytest.approx(score, abs=1e-3)
        assert view.details.score == pytest.approx(score) and view.details.verdict == "true"
        assert view.counts.tp == round((0.9 - score) * 10) + 1


def test_the_histogram_has_a_bar_for_every_detection(session: Session) -> None:
    report = session.report(session.state)
    svg = histogram_svg(report, session.state, "detector")
    heights = [
        sum(float(h) for h in re.findall(rf'height="([\d.]+)" fill="{re.escape(css(rgb))}"', svg))
        for rgb in (palette.TP, palette.FP)
    ]
    curve = report.curves["detector", 0.5]
    assert (hits_of(curve).sum(), (~hits_of(curve)).sum()) == (4, 1)
    assert heights[0] == pytest.approx(4 * heights[1], rel=0.01)
