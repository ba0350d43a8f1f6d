"""Pictures of errors by cause, and the cause on the card."""

from dataclasses import replace
from functools import partial
from xml.etree import ElementTree

import pytest

from dsrc.review import palette
from dsrc.review.errors.gallery import Picture, gallery_html, pictures_of
from dsrc.review.errors.report import run_report
from dsrc.review.frames import Pieces
from dsrc.review.model import ReviewModel
from dsrc.review.page.link import read_link, write_link
from dsrc.review.state import ReviewState
from dsrc.review.texts import selection_report
from dsrc.review.view import DetectionDetails, ObjectDetails
from sensors.frame import Frame
from sim.errors import DataError


@pytest.fixture
def detected(model: ReviewModel) -> ReviewModel:
    """Model of a street of which three frames are detected in: in each one car is missed, and one box is of nothing."""
    for frame in range(3):
        assert model.view(ReviewState(frame=frame)).counts is not None
    return model


def test_the_card_of_an_error_says_why(detected: ReviewModel) -> None:
    state = ReviewState(frame=1, gallery=True)
    (missed,) = [one for one in detected.causes(state) if one.error == "missed"]
    details = detected.view(replace(state, object_id=missed.object_id)).details
    assert isinstance(details, ObjectDetails)
    assert details.cause == f"no box: {missed.sentence}" and missed.points == 3 * 40
    assert "no box: no box overlaps it, with 120 points on it" in selection_report(details)
    (false,) = [one for one in detected.causes(state) if one.error == "false"]
    card = detected.view(replace(state, detection=false.rank)).details
    assert isinstance(card, DetectionDetails) and card.cause.startswith("of nothing: score 0.40: no road user is there")
    right = detected.view(replace(state, detection=0)).details
    assert isinstance(right, DetectionDetails) and right.cause == "", "what is right has no cause"


def test_errors_are_drawn_by_cause_and_open_as_they_are_drawn(detected: ReviewModel) -> None:
    state = ReviewState(gallery=True)
    pictures = list(pictures_of(detected, state, run_report(detected, state).errors))
    assert [one.kind for one in pictures].count("missed: no box") == 3
    assert [one.kind for one in pictures].count("false: of nothing") == 3
    links = [f"?{write_link(detected, one.opens, None)}" for one in pictures]
    for one, link in zip(pictures, links, strict=True):
        shown, _, wrong = read_link(link[1:], detected, ReviewState())
        own = detected.cause(shown)
        assert not wrong and shown.gallery and own is not None and own.sentence == one.sentence
        paths = ElementTree.fromstring(one.svg).findall("path")
        color = palette.css(palette.FN if own.error == "missed" else palette.FP)
        assert any(path.get("stroke") == color for path in paths)
        lines = [path for path in paths if path.get("stroke-width") == "0.22" and "Z" not in path.get("d", "")]
        assert len(lines) == (3 if own.error == "missed" else 0), "a line from each agent to what is missed"
    html = gallery_html(pictures, links)
    assert html.count("<svg") == html.count("<a href") == 6
    assert "missed: no box · 3" in html and "false: of nothing · 3" in html
    assert "<b" not in gallery_html([replace(pictures[0], sentence="<b>")], ["?"]).split("</b>", 1)[1]


def test_a_frame_that_cannot_be_read_is_named_among_the_others(
    detected: ReviewModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = ReviewState()
    report = run_report(detected, state)
    recorded = detected.stores[0].recorded

    def damaged(row: int) -> Frame:
        if row == 1:
            raise DataError("street/000001: points: expected a whole file, found a damaged one")
        return recorded(row)

    monkeypatch.setattr(detected.stores[0], "recorded", damaged)
    pictures = list(pictures_of(detected, state, report.errors))
    wrong = [one for one in pictures if one.kind == "not read"]
    assert len(wrong) == 2 and len(pictures) == 6 and "a damaged one" in wrong[0].sentence


def test_pictures_come_piece_by_piece_and_are_begun_anew_for_other_errors(detected: ReviewModel) -> None:
    state, pieces = ReviewState(), Pieces[Picture]()
    report = run_report(detected, state)
    make = partial(pictures_of, detected, state, report.errors)
    assert pieces.of(report, make, 0.0) == ([], False)
    found, whole = pieces.of(report, make, 60.0)
    assert whole and len(found) == 6 and pieces.of(report, make, 60.0) == (found, True)
    assert pieces.of(run_report(detected, state), make, 0.0) == ([], False)
