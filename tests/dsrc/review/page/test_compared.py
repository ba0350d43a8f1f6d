"""Methods over each other: each further one is drawn in its own colour and form."""

import re

import numpy as np
import pytest

from dsrc.review import palette
from dsrc.review.model import ReviewModel
from dsrc.review.page.commands import lay_over
from dsrc.review.page.panels.labs.corruption import CorruptionLabPanel
from dsrc.review.page.panels.legend import LegendPanel
from dsrc.review.page.panels.run.errors import ErrorsPanel
from dsrc.review.page.session import Session
from dsrc.review.sources.detected import ComputedSet
from tests.dsrc.review.conftest import FakeDetector, FakeDrive
from tests.dsrc.review.errors.test_report import Blind
from tests.dsrc.review.page.test_session import node, panel, wait_for


@pytest.fixture
def model(drive: FakeDrive, detector: FakeDetector) -> ReviewModel:
    model = ReviewModel([drive], detector)
    model.sources[0].sets["blind"] = ComputedSet("blind", Blind())
    return model


def test_two_methods_are_drawn_over_each_other_and_told_apart(session: Session) -> None:
    session.update(methods=("detector", "blind"))
    view = session.wait_drawn()
    (blind,) = view.compared
    drawn = {kind: node(session, f"/compared/0/{kind}") for kind in ("false", "missed")}
    assert len(drawn["false"].points) == 15 * len(blind.false) > 0
    assert len(drawn["missed"].points) > 13 * len(blind.missed) > 0
    np.testing.assert_array_equal(np.unique(drawn["missed"].colors.reshape(-1, 3), axis=0), [palette.method_color(1)])
    row = ">blind</td>" + "".join(rf"<td[^>]*>{n}</td>" for n in (blind.counts.tp, blind.counts.fp, blind.counts.fn))
    wait_for(lambda: re.search(row, panel(session, LegendPanel).text.content))


def test_one_method_alone_leaves_nothing_of_the_other(session: Session) -> None:
    session.update(methods=("detector", "blind"))
    session.wait_drawn()
    session.update(methods=("blind",))
    assert session.wait_drawn().compared == ()
    assert not any(node(session, f"/compared/0/{kind}").visible for kind in ("false", "missed"))


def test_the_list_is_of_the_methods_that_are_left(session: Session, fake_fog: list[tuple[int, str, int]]) -> None:
    errors, lab = panel(session, ErrorsPanel), panel(session, CorruptionLabPanel)
    lay_over(session)
    session.update(error_method="blind")
    session.wait_drawn()
    wait_for(lambda: "blind" in errors.scores.content)
    lay_over(session)
    session.wait_drawn()
    wait_for(lambda: "detector" in errors.scores.content)
    assert session.state.error_method == "" and "blind" not in errors.scores.content
    session.update(corruption="fog", severity=5)
    session.wait_drawn()
    wait_for(lambda: "against clean" in errors.progress.content)
    severity = next(control.handle for control in lab.controls if control.control.field == "severity")
    assert severity.value == 5 and not session._notice.visible
