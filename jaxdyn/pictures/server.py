"""Local servers of viser for browser pages: their ports, log records and browsers."""

import contextlib
import io
import logging
import os
import socket
import sys
import webbrowser
from collections.abc import Iterator
from typing import Any

HOST = "127.0.0.1"


def start_server(port: int) -> Any:
    try:
        import viser
    except ImportError as error:
        raise ImportError("the viewer needs viser: pip install jaxdyn[view]") from error
    # Before the server starts, since browsers may connect at once.
    _port_filter.ports.add(port)
    logging.getLogger("websockets.server").addFilter(_port_filter)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        return viser.ViserServer(host=HOST, port=port, label="jaxdyn", verbose=False)


def stop_server(server) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
    _port_filter.ports.discard(server.get_port())
    if not _port_filter.ports:
        logging.getLogger("websockets.server").removeFilter(_port_filter)


class _PortFilter(logging.Filter):
    """Log filter for our own ports, to which probes connect without a request (a browser's, a test's).

    Records of other servers in the process pass.
    """

    def __init__(self):
        super().__init__()
        self.ports: set[int] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        address = getattr(getattr(record, "websocket", None), "local_address", None)
        return not (isinstance(address, tuple) and len(address) > 1 and address[1] in self.ports)


_port_filter = _PortFilter()


@contextlib.contextmanager
def recording_server() -> Iterator[Any]:
    """Temporary server for recording a page; viser records only from a server."""
    server = start_server(free_port(None))
    try:
        yield server
    finally:
        stop_server(server)


def free_port(port: int | None) -> int:
    """Check that a port is free, or find a free one. **Raises:** ValueError for one in use or out of range."""
    if port is not None and not (isinstance(port, int) and 0 < port < 65536):
        raise ValueError(f"port is {port!r}; give a number from 1 to 65535, or None for a free one")
    with socket.socket() as probe:
        # A port in TIME_WAIT, of a viewer just closed, counts as free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port or 0))
        except OSError as error:
            raise ValueError(
                f"port {port} cannot be used ({error.strerror}); give another one, or None for a free one"
            ) from error
        return probe.getsockname()[1]


def open_browser(url: str) -> bool:
    """Open a graphical browser; return False where there is none."""
    if sys.platform.startswith("linux") and not any(
        os.environ.get(x) for x in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    ):
        return False
    return webbrowser.open(url)


def is_interactive() -> bool:
    # sys.ps1 exists at a prompt only.
    return hasattr(sys, "ps1") or "ipykernel" in sys.modules
