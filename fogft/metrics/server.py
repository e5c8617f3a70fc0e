"""The HTTP server that serves metrics.

A slow or hostile scraper occupies a thread; there are few, so a new connection ends the oldest.
"""

import contextlib
import socket
from collections.abc import Callable
from socketserver import ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from fogft.model.names import host_and_port

_LIMIT_S = 5.0
_AT_ONCE = 8


def bound(endpoint: str, app: Callable[..., Any]) -> WSGIServer:
    """Return a server of a WSGI application, bound to ``host:port``, that does not serve yet."""
    return make_server(*host_and_port(endpoint), app, _Server, _Request)


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True

    def server_activate(self) -> None:
        self._open: dict[socket.socket, None] = {}  # oldest first
        super().server_activate()

    def process_request(self, request: Any, client_address: Any) -> None:
        self._open[request] = None
        if len(self._open) > _AT_ONCE:
            oldest = list(self._open)[0]  # noqa: RUF015 - atomic: other threads remove theirs
            self._open.pop(oldest, None)
            with contextlib.suppress(OSError):  # its thread closes it
                oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        self._open.pop(request, None)
        super().shutdown_request(request)


class _Request(WSGIRequestHandler):
    timeout = _LIMIT_S

    def log_message(self, format: str, *arguments: object) -> None:
        """Log no line for each scrape."""
