"""viser server on a checked port, without its banner, for pages of its own origin alone."""

import contextlib
import http
import io
import logging
import socket
import threading
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from dsrc.review.page.browser import HEAD
from dsrc.review.page.cells import HTML, PATH
from sim.errors import SettingsError, complaint

LOOPBACK = "127.0.0.1"
_LOOPBACK_NAMES = ("127.0.0.1", "localhost", "::1")
_starting = threading.Lock()

Process = Callable[[Any, Request], Response | None]


def free_port(host: str = LOOPBACK) -> int:
    """Free port of a host."""
    with socket.socket() as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


def checked_port(host: str = LOOPBACK, port: int | None = None) -> int:
    """Return the port, a free one for None; viser would silently take the next of one in use.

    Raises:
        SettingsError: the port is taken, or `host` is not an address of this machine.
    """
    try:
        wanted = free_port(host) if port is None else port
    except OSError as error:
        raise SettingsError(complaint("view", "host", "an address of this machine", f"{host} ({error})")) from None
    if not 1 <= wanted <= 65535:
        raise SettingsError(complaint("view", "port", "1 to 65535", wanted))
    with socket.socket() as probe:
        # As servers do: a port in TIME_WAIT is free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, wanted))
        except OSError as error:
            found = f"{wanted} ({error.strerror or error})"
            raise SettingsError(
                complaint("view", "port", f"a free port of {host}", found, "; leave --port out")
            ) from None
    return wanted


def start_server(host: str = LOOPBACK, port: int | None = None, allow_origin: Sequence[str] = ()) -> viser.ViserServer:
    """Start a server; the caller stops it.

    Args:
        allow_origin: further hosts that the page is asked by, of proxies and tunnels that lead here.

    Raises:
        SettingsError: the port is taken, `host` is not an address of this machine, or an origin is no host.
    """
    allowed = allowed_hosts(allow_origin)
    wanted = checked_port(host, port)
    # A browser may go while a frame is on its way to it.
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
    logging.getLogger("websockets.server").addFilter(_worth_telling)
    # viser prints a banner to standard output, which belongs to the command's results.
    with _own_requests(host, allowed), contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=host, port=wanted, label="Review", verbose=False)


def _worth_telling(record: logging.LogRecord) -> bool:
    """Whether a record is none of a connection without a request: browsers open some ahead and drop them."""
    return "handshake failed" not in record.getMessage()


@contextlib.contextmanager
def _own_requests(host: str, allowed: Collection[str]) -> Iterator[None]:
    """Answer the requests of servers started in the block ourselves where viser's answer does not do."""
    # viser takes no `process_request` of its own, and starts its server while it is constructed.
    serve = websockets.asyncio.server.serve

    def guarded(*args: Any, process_request: Process, **kwargs: Any) -> Any:
        return serve(*args, process_request=_answer(process_request, host, allowed), **kwargs)

    with _starting:
        websockets.asyncio.server.serve = guarded  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _answer(process: Process, host: str, allowed: Collection[str]) -> Process:
    """Answer of the server: nothing for other origins, and the page with our script in its head."""

    def answer(connection: object, request: Request) -> Response | None:
        if not same_origin(request.headers, host, allowed):
            return Response(http.HTTPStatus.FORBIDDEN, "FORBIDDEN", Headers(), b"this page is for its own origin alone")
        if request.path.partition("?")[0] == PATH:
            body = HTML.encode()
            head = Headers([("Content-Type", "text/html; charset=utf-8"), ("Content-Length", str(len(body)))])
            return Response(http.HTTPStatus.OK, "OK", head, body)
        if request.path.partition("?")[0] != "/":
            return process(connection, request)
        # Packed it would be unpacked here again.
        request.headers.pop("Accept-Encoding", None)
        response = process(connection, request)
        if response is not None and response.body is not None:
            response.body = response.body.replace(b"<head>", b"<head>" + HEAD.encode(), 1)
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))
        return response

    return answer


def allowed_hosts(given: Sequence[str]) -> frozenset[str]:
    """Return the hosts of names or addresses, `hub.example.org` of `https://hub.example.org:8000/user`.

    Raises:
        SettingsError: one is no host; `*` is none, since any page could then read this one.
    """
    hosts = set()
    for text in given:
        try:
            name = urlsplit(text if "//" in text else f"//{text}").hostname
        except ValueError:
            name = None
        if not name or "*" in name:
            raise SettingsError(complaint("view", "allow-origin", "a host, such as hub.example.org", text))
        hosts.add(name)
    return frozenset(hosts)


def same_origin(headers: Headers, host: str, allowed: Collection[str] = ()) -> bool:
    """Whether a request comes from a page of this server, from one of an allowed host, or from no page.

    Pages of any origin may open a websocket to the loopback, and a foreign name may be made to lead to it: a browser
    tells both in the headers.

    Args:
        host: address that the server listens on.
        allowed: further hosts, of proxies, which may keep the name that they were asked by or put ours in its place.
    """
    name, origin = headers.get("Host", ""), headers.get("Origin")
    if host in _LOOPBACK_NAMES and urlsplit(f"//{name}").hostname not in {*_LOOPBACK_NAMES, *allowed}:
        return False
    return origin is None or urlsplit(origin).netloc == name or urlsplit(origin).hostname in allowed


def link_of(server: viser.ViserServer, client_id: int) -> str:
    """Query of the address with which a browser connected, "" without one."""
    connection = server._websock_server._live_connections.get(client_id)
    request = None if connection is None else connection.request
    return "" if request is None else request.path.partition("?")[2]


def address(server: viser.ViserServer) -> str:
    """URL of the page."""
    return f"http://{server.get_host()}:{server.get_port()}"


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server and its threads."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
