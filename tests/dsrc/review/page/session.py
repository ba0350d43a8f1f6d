"""Parts of a page's session, by name and by kind, and waiting for what it does."""

import time


def wait_for(condition, timeout_s=10.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


def panel(session, kind):
    return next(panel for panel in session.panels if isinstance(panel, kind))


def node(session, name):
    return session.client.scene.get_handle_by_name(f"/drive0{name}")
