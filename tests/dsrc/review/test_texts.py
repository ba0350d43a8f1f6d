from dataclasses import replace

from dsrc.review.model import ReviewModel
from dsrc.review.state import ReviewState
from dsrc.review.texts import selection_report, summary
from tests.dsrc.review.conftest import cells


def test_what_files_name_is_no_element_of_a_page(model: ReviewModel) -> None:
    name = "<b>**x**|y_1</b>"
    view = model.view(ReviewState(object_id=1003))
    card = selection_report(replace(view.details, lane=name, cause=f"hidden & {name}"))
    shown = "&lt;b&gt;**x**|y_1&lt;/b&gt;"
    assert f"lane {shown}" in card and f"hidden &amp; {shown}" in card and name not in card
    said = summary(replace(view, notice=name))
    assert shown in said and name not in said


def test_tables_of_cards_have_a_head_and_a_row_for_each_agent(model: ReviewModel) -> None:
    card = selection_report(model.view(ReviewState(object_id=1003)).details)
    assert cells(card)[0] == ["", "points", "visible"] and len(cells(card)) == 4


def test_a_column_of_visibility_has_a_head_where_it_is_known(model: ReviewModel) -> None:
    details = model.view(ReviewState(object_id=1003)).details
    unknown = [replace(one, fraction=float("nan")) for one in details.visibility]
    assert "visible" not in selection_report(replace(details, visibility=unknown))
