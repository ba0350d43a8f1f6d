"""Parts of a page's session, by name and by kind, and waiting for what it does."""

import re
import time
from collections.abc import Callable
from typing import Any, TypeVar

from dsrc.review.page.session import Session

P = TypeVar("P")


def wait_for(condition: Callable[[], object], timeout_s: float = 10.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


def panel(session: Session, kind: type[P]) -> P:
    return next(panel for panel in session.panels if isinstance(panel, kind))


def counted(html: str) -> dict[str, int]:
    """What a frame's legend counts, by name."""
    return {name: int(count) for name, count in re.findall(r'data-count="(\w+)">(\d+)<', html)}


def node(session: Session, name: str) -> Any:
    return session.client.scene.get_handle_by_name(f"/drive0{name}")
