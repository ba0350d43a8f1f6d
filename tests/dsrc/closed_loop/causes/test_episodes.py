"""Lines of sight of a perception: whose LiDARs count."""

import math

from dsrc.closed_loop.causes.episodes import _first_heard
from tests.dsrc.closed_loop.perception.test_recast import log_of, message
from tests.dsrc.closed_loop.perception.toy import HELPER


def test_a_helper_counts_from_its_first_message_on_and_one_that_is_never_heard_not_at_all() -> None:
    log = log_of({2: message(-1, math.nan), 4: message(2, 0.2), 6: message(4, 0.2)})
    assert _first_heard(log) == {HELPER: log.ticks[4].actors.time_s}
    assert _first_heard(log_of({2: message(-1, math.nan)})) == {}


def test_without_messages_all_lidars_of_the_perception_count() -> None:
    assert _first_heard(log_of({})) is None
