"""Metrics as `prometheus-client` objects, created for each scrape and served over plain HTTP.

The library counts nothing: on the request path, counting stays a plain addition. It is imported
once an endpoint is configured, like Python's HTTP server (`fogft.metrics.server`), so a process
that nobody scrapes never loads it.
"""

from __future__ import annotations

import logging
import math
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING

import fogft
from fogft.process import on_thread

if TYPE_CHECKING:
    from wsgiref.simple_server import WSGIServer

    from prometheus_client import Metric

log = logging.getLogger(__name__)

Labels = Mapping[str, str]
Values = Iterable[tuple[float, Labels]]
Measure = Callable[[], "Iterable[Metric]"]


def family(name: str, help: str, values: Values) -> Metric:
    """Return what has one name, by labels: counters if it ends in ``_total``, else gauges."""
    from prometheus_client import Metric

    known = name.removesuffix("_total")
    made = Metric(known, help, "gauge" if known == name else "counter")
    for value, labels in values:
        made.add_sample(name, _printable(labels), float(value))
    return made


def histogram(
    name: str,
    help: str,
    bounds: Sequence[float],
    counted: Iterable[tuple[Sequence[int], float, Labels]],
) -> Metric:
    """Return histograms of one name, which ends in its unit.

    `bounds` ascend; one more bucket has none. `counted`: counts by bucket, sum of values, labels.
    """
    from prometheus_client import Metric

    made = Metric(name, help, "histogram")
    for counts, total, labels in counted:
        known, so_far = _printable(labels), 0
        for bound, count in zip((*bounds, math.inf), counts, strict=True):
            so_far += count
            within = "+Inf" if bound == math.inf else str(float(bound))
            made.add_sample(f"{name}_bucket", {**known, "le": within}, so_far)
        made.add_sample(f"{name}_count", known, so_far)
        made.add_sample(f"{name}_sum", known, total)
    return made


def _printable(labels: Labels) -> dict[str, str]:
    """Return labels that can be encoded: lone surrogates are replaced."""
    return {key: value.encode(errors="replace").decode() for key, value in labels.items()}


class Scrape:
    """Serves metrics at an endpoint, which may change or be empty; collected for each request."""

    def __init__(self, measure: Measure, labels: Labels) -> None:
        self._measure = measure
        self._labels = labels
        self._wanted = ""
        self._server: WSGIServer | None = None

    def collect(self) -> Iterator[Metric]:
        """Yield the families that have samples, each with the process's labels."""
        from prometheus_client import ProcessCollector

        version = {"version": fogft.__version__, "python": platform.python_version()}
        yield family("fogft_build_info", "Version of fogft and of Python.", [(1, version)])
        for one in chain(self._measure(), ProcessCollector(registry=None).collect()):
            one.samples = [
                sample._replace(labels={**self._labels, **sample.labels}) for sample in one.samples
            ]
            if one.samples:
                yield one

    @property
    def endpoint(self) -> str:
        """``host:port`` as bound; empty while it is not served."""
        if self._server is None:
            return ""
        host, port = self._server.server_address[:2]
        return f"{host!s}:{port}"

    def at(self, endpoint: str) -> None:
        """Serve at ``host:port`` (port 0: any free port); empty to stop. Repeatable.

        If the port cannot be bound, or no thread starts, that is logged and nothing is served.
        """
        if endpoint == self._wanted:
            return
        self.close()
        self._wanted = endpoint
        if not endpoint:
            return
        from prometheus_client import CollectorRegistry, make_wsgi_app

        from fogft.metrics.server import bound

        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)
        server = None
        try:
            server = bound(endpoint, make_wsgi_app(registry))
            on_thread(server.serve_forever, name="fogft-metrics")
        except (OSError, OverflowError, ValueError) as error:
            log.error("metrics_not_served endpoint=%s reason=%r", endpoint, str(error))
            if server is not None:
                server.server_close()
            return
        self._server = server
        log.info("metrics_served endpoint=%s", self.endpoint)

    def close(self) -> None:
        """Stop serving. Repeatable."""
        server, self._server, self._wanted = self._server, None, ""
        if server is not None:
            server.shutdown()
            server.server_close()
