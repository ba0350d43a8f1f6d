"""Live review page: server, model and what all browsers share, and one session per browser."""

import contextlib
import logging
import os
import threading
from collections.abc import Callable
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

import viser

from dsrc.options.fields import takes_fields
from dsrc.options.review import PageOptions, ServeOptions
from dsrc.review.model import ReviewModel, open_model
from dsrc.review.page.cameras import overview
from dsrc.review.page.cells import PAIR, CellPair
from dsrc.review.page.link import read_link
from dsrc.review.page.scene import set_light, set_start_camera
from dsrc.review.page.server import LOOPBACK, address, allowed_hosts, checked_port, link_of, start_server, stop_server
from dsrc.review.page.session import Session
from dsrc.review.sources.live import LiveSource
from dsrc.review.sources.opening import open_late
from dsrc.review.state import ReviewState
from dsrc.review.static import StaticPart, load_bodies
from dsrc.review.worker import Worker
from sensors.corruptions import Condition
from sim.errors import SettingsError, UserError, complaint

if TYPE_CHECKING:
    from dsrc.data.drives import Drive

    # The closed loop takes a second to import.
    from dsrc.review.sources.episodes import EpisodeSource

log = logging.getLogger(__name__)

INTERRUPTED_S = 1.0
"""Time that an interrupted page waits for a detection, s."""
PICTURE_S = 10.0
"""Longest time for which opening a detector waits for a browser and its first picture, s."""


class ReviewApp:
    """Live review page on a running server, until `close`: sessions by browser, and what all of them share.

    Attributes:
        model: drives, detector and caches.
        server: viser server.
        start: state of a browser that opens the page without a link.
        sessions: running sessions by the id of their browser.
        worker: detects over whole runs in the background.
        url: address of the page.
        busy: whether something still ran when an interrupt had closed it.
        pictured: cleared where a detector is to be opened after the first picture of a browser, set by that.
    """

    def __init__(self, model: ReviewModel, server: viser.ViserServer, start: ReviewState | None = None) -> None:
        self.model, self.server, self.start = model, server, start or ReviewState()
        model.start = self.start
        self.url = address(server)
        self.sessions: dict[int, Session] = {}
        self.worker, self.pictured = Worker(), threading.Event()
        self.pictured.set()
        self._using_model = threading.Lock()
        self._changed = threading.Condition()
        self._closed = self.busy = False
        self._pairs: dict[str, CellPair] = {}
        set_light(server.scene)
        server.on_client_connect(self._open)
        server.on_client_disconnect(self._end)

    def _repr_html_(self) -> str:
        """Return the page in a frame, as notebooks show it: on a JupyterHub through its proxy of ports."""
        hub = os.environ.get("JUPYTERHUB_SERVICE_PREFIX", "")
        source = f"{hub}proxy/{self.server.get_port()}/" if hub else self.url
        look = 'width="100%" height="600" style="border:0" allow="clipboard-write"'
        return f'<iframe src="{escape(source)}" {look}></iframe>'

    def wait_session(self, count: int = 1, timeout_s: float = 30.0) -> list[Session]:
        """Wait until at least `count` browsers are connected and return their sessions, oldest first."""
        with self._changed:
            if not self._changed.wait_for(lambda: len(self.sessions) >= count or self._closed, timeout_s):
                raise TimeoutError(f"{len(self.sessions)} of {count} browsers connected in time")
            return [session for _, session in sorted(self.sessions.items())]

    def wait(self) -> None:
        """Serve until the page is closed or the process interrupted."""
        with self._changed:
            while not self._closed:
                self._changed.wait(1.0)

    def close(self, patience_s: float = 60.0) -> bool:
        """Stop the sessions and the server; return whether all have stopped, each in this time."""
        with self._changed:
            self._closed = True
            sessions, self.sessions = list(self.sessions.values()), {}
            self._changed.notify_all()
        stopped = [session.close(min(patience_s, 10.0)) for session in sessions]
        stopped.append(self.worker.close(patience_s))
        # A server waits for connections that browsers have opened ahead and that ask nothing.
        stopping = threading.Thread(target=stop_server, args=(self.server,), daemon=True)
        stopping.start()
        stopping.join(patience_s)
        return all(stopped) and not stopping.is_alive()

    def _open(self, client: viser.ClientHandle) -> None:
        link = link_of(self.server, client.client_id)
        state, pose, complaints = read_link(link, self.model, self.start)
        session = Session(
            *(self.model, self._using_model, self.worker, client, self.server.get_event_loop(), state),
            *(pose, "\n".join(complaints), self._world, self._wait_picture),
        )
        with self._changed:
            connected = not self._closed and client.client_id in self.server.get_clients()
            if connected:
                self.sessions[client.client_id] = session
                self._changed.notify_all()
        if not connected:
            session.close()
            return
        name, _, place = dict(parse_qsl(link)).get(PAIR, "").partition(".")
        if name:
            session.place = int(place) if place.isdecimal() else 0
            with self._changed:
                pair = self._pairs.setdefault(name, CellPair())
            session.pair = pair
            pair.add(session)

    def _end(self, client: viser.ClientHandle) -> None:
        with self._changed:
            session = self.sessions.pop(client.client_id, None)
            self._changed.notify_all()
            left = session.pair if session is not None else None
        if left is not None and session is not None:
            left.remove(session)
            with self._changed:
                self._pairs = {name: pair for name, pair in self._pairs.items() if pair.cells}
        if session is not None:
            session.close()

    def _wait_picture(self, client: viser.ClientHandle) -> None:
        """Wait until the first browser has drawn what it was sent: a detector that opens would take its cores."""
        if not self.pictured.is_set():
            with contextlib.suppress(RuntimeError, TimeoutError):  # it has gone, or draws nothing in the background
                client.get_render(2, 2, timeout=PICTURE_S)
            self.pictured.set()

    def _world(self, drive: int) -> tuple[list[StaticPart], str]:
        with self._using_model:
            return self.model.world(drive)


class LivePage(contextlib.AbstractContextManager):
    """Page, during a block, on frames that are still being made; whoever hands them to the source never waits.

    Attributes:
        source: the frames.
        app: the page.
        url: its address.
    """

    def __init__(self, source: "LiveSource | EpisodeSource", host: str = LOOPBACK, port: int | None = None) -> None:
        """Serve a page on a source.

        Args:
            source: of the frames, none so far.
            port: of the page; None for a free one.

        Raises:
            SettingsError: the port is taken, or `host` is not an address of this machine.
        """
        self.source = source
        self.app = ReviewApp(ReviewModel([source]), start_server(host, port))
        self.url = self.app.url

    def wait(self) -> None:
        """Mark that no more frames come, and serve until interrupted."""
        self.source.end()
        with contextlib.suppress(KeyboardInterrupt):
            self.app.wait()

    def close(self) -> None:
        """Stop the page."""
        self.source.end()
        self.app.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def first_state(model: ReviewModel, options: ServeOptions | PageOptions) -> ReviewState:
    """State of the first browser: the frame that was asked for, else the first drive's that can be drawn.

    Raises:
        SettingsError: the first drive has no frame of that number.
        DataError: no frame of any drive can be read; what is wrong with the first.
    """
    state = ReviewState(
        frame=options.frame,
        corruption=options.corruption,
        severity=options.severity,
        family=options.family,
        corrupted_agents=options.corrupted_agents,
    )
    last = len(model.sources[0]) - 1
    if not 0 <= options.frame <= last:
        raise SettingsError(complaint("view", "frame", f"0 to {last}", options.frame))
    first: UserError | None = None
    for drive in range(len(model.sources)):
        try:
            model.readable_frame(drive)
        except UserError as error:
            first = first or error
        else:
            asked = drive == 0 and options.frame > 0
            return state if asked else replace(state, drive=drive, **model.opening(drive))
    raise first or SettingsError(complaint("view", "data", "a drive", "none"))


def view(data: "Drive | Path | str", **options: Any) -> ReviewApp:
    """Show a review page in a notebook, in a frame below the cell, while the notebook goes on.

    Args:
        data: a drive, or a path as `dsrc view` takes it.
        options: of `ServeOptions`. The frame is asked for at this machine, on a JupyterHub through jupyter-server-proxy
            with the hub's host as `allow_origin`. Where the notebook runs elsewhere otherwise, give the port to the
            tunnel and the tunnel's host as `allow_origin`.

    Returns:
        The page: `close()` ends it, `url` is its address.

    Raises:
        UserError: see `serve`.
    """
    path = data if isinstance(data, str | Path) else data.drive
    return serve(ServeOptions(Path(path), **options), block=False)


@takes_fields(ServeOptions)
def serve(options: ServeOptions, block: bool = True, announce: Callable[[str], None] | None = None) -> ReviewApp:
    """Serve a review page of drives.

    Args:
        options: drives, detector, first frame and corruption, host and port, see `ServeOptions`; or these as arguments.
        block: serve until interrupted; otherwise return the running page.
        announce: called with the address of the page once it answers.

    Returns:
        The page; `url` is its address, `close` ends it.

    Raises:
        DataError: there is no drive, or none that can be read.
        SettingsError: the corruption or the frame is unknown, or the port taken.
        CheckpointError: the checkpoint cannot be loaded.
    """
    Condition.of(options.corruption, options.severity, options.family, options.corrupted_agents).checked()
    port, _ = checked_port(options.host, options.port), allowed_hosts(options.allow_origin)  # told before the work
    model = open_model(options.data, options.checkpoint, options.drives, options.engine, options.height, late=True)
    start = first_state(model, options)
    server = start_server(options.host, port, options.allow_origin)
    app = ReviewApp(model, server, start)
    known = options.checkpoint is not None and Path(options.checkpoint).is_file()
    if block and known:  # what is missing is told at once
        app.pictured.clear()
    try:
        set_start_camera(server, overview(model.sketch(start)))
    except UserError as error:
        # The page says so too, and draws the next frame.
        log.warning("%s", error)
    log.info("review page: %s", app.url)
    if announce is not None:
        announce(app.url)
    try:
        # While the browser loads the page, a mesh takes half a second to import; torch, which takes more, after it.
        load_bodies()
        app.pictured.wait(PICTURE_S)
        open_late(model.sources)
        if block:
            app.wait()
    except KeyboardInterrupt:
        app.busy = not app.close(INTERRUPTED_S)
        if not block:
            raise
        log.info("review page closed")
    except BaseException:
        app.close()
        raise
    return app
