"""Serve metrics to Prometheus: ``GET /metrics`` over plain HTTP, answered by `prometheus-client`.

Few threads, short limits: a scraper that is slow or hostile costs one of them for a moment.
Whatever goes wrong here harms nothing else in the process.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

from fogft.metrics.families import Labels, text
from fogft.model.names import host_and_port

if TYPE_CHECKING:
    from prometheus_client import Metric

log = logging.getLogger(__name__)

_CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_LIMIT_S = 5.0
_AT_ONCE = 4

Measure = Callable[[], "Iterable[Metric]"]


class Scrape:
    """Metrics at an endpoint, which may change or be none; measured for each request."""

    def __init__(self, measure: Measure, labels: Labels) -> None:
        self._tell = lambda: text(measure(), labels)
        self._wanted = ""
        self._server: _Server | None = None

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
        try:
            self._server = _Server(host_and_port(endpoint), self._tell)
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


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 16

    def __init__(self, address: tuple[str, int], tell: Callable[[], str]) -> None:
        super().__init__(address, _Request)
        self.tell = tell
        self.room = threading.BoundedSemaphore(_AT_ONCE)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self.room.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        log.debug("scrape_failed client=%s", client_address, exc_info=True)


class _Request(BaseHTTPRequestHandler):
    timeout = _LIMIT_S
    server: _Server

    def do_GET(self) -> None:
        """Answer a scrape."""
        if self.path.partition("?")[0] != "/metrics":
            self.send_error(404)
            return
        try:
            body = self.server.tell().encode()
        except Exception:
            log.exception("metrics_not_measured")
            self.send_error(500)
            return
        self.send_response(200)
        self.send_header("Content-Type", _CONTENT_TYPE)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log no line for each scrape."""
