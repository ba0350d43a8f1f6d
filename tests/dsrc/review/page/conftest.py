"""A page with a browser that is only a websocket: it says where its camera is and takes what comes."""

import threading
from collections.abc import Iterator, Sequence

import msgspec
import pytest
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.server import start_server
from dsrc.review.page.session import Session


class SocketBrowser:
    """Connection of a browser that draws nothing.

    Attributes:
        camera: position and point looked at that it was given last, by the names of their messages.
    """

    def __init__(self, app: ReviewApp, link: str = "", width: int = 1280) -> None:
        """Connect to the page of `app` as if its address had the query `link`."""
        url = f"{app.url.replace('http', 'ws')}/?{link}"
        known = set(app.sessions)
        self.camera: dict[str, Sequence[float]] = {}
        self.socket = connect(url, subprotocols=[f"viser-v{viser.__version__}"], max_size=None, compression=None)
        self.look_from((30.0, 0.0, 20.0), (0.0, 0.0, 0.0), width)
        threading.Thread(target=self._take, daemon=True).start()
        app.wait_session(len(known) + 1)
        (number,) = set(app.sessions) - known
        self.session: Session = app.sessions[number]

    def look_from(self, position: Sequence[float], look_at: Sequence[float], width: int = 1280) -> None:
        """Report a pose of the camera, as a browser does after every motion."""
        message = {
            "type": "ViewerCameraMessage",
            "wxyz": (1.0, 0.0, 0.0, 0.0),
            "position": position,
            "fov": 0.9,
            "near": 0.5,
            "far": 2000.0,
            "image_height": 720,
            "image_width": width,
            "look_at": look_at,
            "up_direction": (0.0, 0.0, 1.0),
        }
        self.socket.send(msgspec.msgpack.encode(message))

    def close(self) -> None:
        self.socket.close()

    def _take(self) -> None:
        try:
            while True:
                content = self.socket.recv()
                assert isinstance(content, bytes)
                # Two numbers of bytes, the messages, and their arrays.
                packed = zstandard.decompress(content[16 : 16 + int.from_bytes(content[8:16], "little")])
                for message in msgspec.msgpack.decode(packed)["messages"]:
                    if not message.get("initial"):
                        given = {"SetCameraPositionMessage": "position", "SetCameraLookAtMessage": "look_at"}
                        if (name := given.get(message["type"])) is not None:
                            self.camera[name] = message[name]
        except ConnectionClosed:
            pass


@pytest.fixture
def app(model: ReviewModel) -> Iterator[ReviewApp]:
    app = ReviewApp(model, start_server())
    yield app
    app.close()


@pytest.fixture
def connect_browser() -> type[SocketBrowser]:
    """Connect a further browser: a function of a page, a link and a width."""
    return SocketBrowser


@pytest.fixture
def browser(app: ReviewApp) -> SocketBrowser:
    browser = SocketBrowser(app)
    browser.session.wait_drawn()
    return browser


@pytest.fixture
def session(browser: SocketBrowser) -> Session:
    return browser.session
