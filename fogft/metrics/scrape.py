"""Serve metrics to Prometheus over plain HTTP, by `prometheus-client`'s own application.

A scraper that is slow or hostile costs a thread for seconds. Whatever goes wrong here harms nothing
else in the process.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from fogft.metrics.families import Labels, registry
from fogft.model.names import host_and_port

if TYPE_CHECKING:
    from prometheus_client import Metric

log = logging.getLogger(__name__)

_LIMIT_S = 5.0

Measure = Callable[[], "Iterable[Metric]"]


class Scrape:
    """Metrics at an endpoint, which may change or be none; measured for each request."""

    def __init__(self, measure: Measure, labels: Labels) -> None:
        self._measure = measure
        self._labels = labels
        self._wanted = ""
        self._server: WSGIServer | None = None

    @property
    def endpoint(self) -> str:
        """``host:port`` as bound; empty while it is not served."""
        if self._server is None:
            return ""
        host, port = self._server.server_address[:2]
        return f"{host!s}:{port}"

    def at(self, endpoint: str) -> None:
        """Serve at ``host:port`` (port 0 for any that is free); empty for nowhere. Repeatable.

        A port that cannot be had is logged, and nothing is served.
        """
        if endpoint == self._wanted:
            return
        self.close()
        self._wanted = endpoint
        if not endpoint:
            return
        from prometheus_client import make_wsgi_app

        app = make_wsgi_app(registry(self._measure, self._labels))
        try:
            self._server = make_server(*host_and_port(endpoint), app, _Server, _Request)
        except (OSError, OverflowError, ValueError) as error:
            log.error("metrics_not_served endpoint=%s reason=%r", endpoint, str(error))
            return
        threading.Thread(
            target=self._server.serve_forever, name="fogft-metrics", daemon=True
        ).start()
        log.info("metrics_served endpoint=%s", self.endpoint)

    def close(self) -> None:
        """Give the port back. Repeatable."""
        server, self._server, self._wanted = self._server, None, ""
        if server is not None:
            server.shutdown()
            server.server_close()


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True
    block_on_close = False


class _Request(WSGIRequestHandler):
    timeout = _LIMIT_S

    def log_message(self, format: str, *arguments: object) -> None:
        """Log no line for each scrape."""
