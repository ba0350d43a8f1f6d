"""viser server on the loopback, on a checked port, without its banner."""

import contextlib
import io
import socket

import viser

from sim.errors import SettingsError, complaint

LOOPBACK = "127.0.0.1"


def free_port(host: str = LOOPBACK) -> int:
    """Free port of a host."""
    with socket.socket() as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


def check_port(host: str, port: int) -> None:
    """Raise SettingsError for a port in use; viser would silently take the next one."""
    if not 1 <= port <= 65535:
        raise SettingsError(complaint("view", "port", "1 to 65535", port))
    with socket.socket() as probe:
        # As servers do: a port in TIME_WAIT is free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            reason = error.strerror or str(error)
            raise SettingsError(
                complaint("view", "port", f"a free port of {host}", f"{port} ({reason})", "; leave --port out")
            ) from None


def start_server(host: str = LOOPBACK, port: int | None = None) -> viser.ViserServer:
    """Start a server; the caller stops it.

    Raises:
        SettingsError: the port is taken, or `host` is not an address of this machine.
    """
    try:
        wanted = free_port(host) if port is None else port
    except OSError as error:
        raise SettingsError(complaint("view", "host", "an address of this machine", f"{host} ({error})")) from None
    check_port(host, wanted)
    # viser prints a banner to standard output, which belongs to the command's results.
    with contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=host, port=wanted, label="Review", verbose=False)


def address(server: viser.ViserServer) -> str:
    """URL of the page."""
    return f"http://{server.get_host()}:{server.get_port()}"


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server and its threads."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
