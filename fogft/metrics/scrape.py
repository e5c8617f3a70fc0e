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


def counter(name: str, help: str, values: Values) -> Metric:
    """Return counters of one name, which ends in ``_total``, by their labels."""
    return _family(name.removesuffix("_total"), "counter", help, values, "_total")


def gauge(name: str, help: str, values: Values) -> Metric:
    """Return gauges of one name by their labels; a name ends in its unit."""
    return _family(name, "gauge", help, values)


def histogram(
    name: str,
    help: str,
    bounds: Sequence[float],
    counted: Iterable[tuple[Sequence[int], float, Labels]],
) -> Metric:
    """Return histograms of one name, which ends in its unit.

    `bounds` ascend; one more bucket has none. `counted`: counts by bucket, sum of values, labels.
    """
    family = _family(name, "histogram", help, ())
    for counts, total, labels in counted:
        known, so_far = _printable(labels), 0
        for bound, count in zip((*bounds, math.inf), counts, strict=True):
            so_far += count
            within = "+Inf" if bound == math.inf else str(float(bound))
            family.add_sample(f"{name}_bucket", {**known, "le": within}, so_far)
        family.add_sample(f"{name}_count", known, so_far)
        family.add_sample(f"{name}_sum", known, total)
    return family


def _family(name: str, kind: str, help: str, values: Values, suffix: str = "") -> Metric:
    from prometheus_client import Metric

    family = Metric(name, help, kind)
    for value, labels in values:
        family.add_sample(f"{name}{suffix}", _printable(labels), float(value))
    return family


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
        yield gauge("fogft_build_info", "Version of fogft and of Python.", [(1, version)])
        for family in chain(self._measure(), ProcessCollector(registry=None).collect()):
            family.samples = [
                sample._replace(labels={**self._labels, **sample.labels})
                for sample in family.samples
            ]
            if family.samples:
                yield family

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
