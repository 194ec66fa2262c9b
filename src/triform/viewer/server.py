"""The server of a page, on this computer alone unless another address is asked for."""

from __future__ import annotations

import contextlib
import io
import socket

import viser

from triform.types import TriformError


def open_server(host: str, port: int, title: str) -> viser.ViserServer:
    """Start a server whose page has the title, without a word on the terminal.

    Args:
        host: Address at which it is reached.
        port: Port; the next free one if it is taken.
        title: Title of the panel.

    Raises:
        TriformError: This computer has no such address.
    """
    try:
        # A server of viser waits forever for an address that it cannot have.
        socket.create_server((host, 0)).close()
    except OSError as error:
        raise TriformError(f"no page can be served at {host!r}: {(error.strerror or str(error)).lower()}") from None
    with contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=host, port=port, label=title, verbose=False)


def close_server(server: viser.ViserServer) -> None:
    """Stop a server, without a word on the terminal."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
