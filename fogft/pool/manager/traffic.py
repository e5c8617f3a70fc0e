"""What is asked of a pool's services, as its client proxy has counted.

Costs need request sizes and rates. The pool file's word goes first; where it says nothing, what the
client proxy has counted since it started is taken for the whole month. A report says so even when
the proxy that wrote it is gone.

Owns: sizes and rates from a report.
Not here: counting (`fogft.metrics.outcomes`), costs (`fogft.planning.cost`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from fogft.model.choices import TrafficSpec
from fogft.model.spec import PoolSpec, ServiceSpec
from fogft.pool.manager import proxy_report
from fogft.pool.manager.proxy_report import ProxyReport

# Shorter than this, one burst would pass for a month.
LEAST_S = 60.0


@dataclass(frozen=True)
class Measured:
    """What was counted of one service.

    Attributes:
        over_s: For how long, in seconds.
        requests: How many came meanwhile.
    """

    traffic: TrafficSpec
    over_s: float
    requests: int


def measured(proxy_status: Path, pool_uid: str) -> dict[str, Measured]:
    """Return what was counted of each service; those of which nothing is known are left out."""
    report = proxy_report.read(proxy_status, pool_uid)
    if report is None or not report.uptime_s >= LEAST_S:
        return {}
    counted = {name: _measured(report, name) for name in report.services}
    return {name: one for name, one in counted.items() if one is not None}


def _measured(report: ProxyReport, name: str) -> Measured | None:
    count = report.services[name]
    try:
        requests, answers = int(count["received"]), int(count["answered"])
        sizes = float(count["request_bytes"]), float(count["response_bytes"])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    if requests <= 0 or answers < 0 or not all(0 <= size < float("inf") for size in sizes):
        return None
    traffic = TrafficSpec(
        requests / report.uptime_s, sizes[0] / requests, sizes[1] / answers if answers else 0.0
    )
    return Measured(traffic, report.uptime_s, requests)


def with_measured(spec: PoolSpec, found: dict[str, Measured]) -> PoolSpec:
    """Return a pool file whose services carry what was measured where it states nothing."""

    def carried(service: ServiceSpec) -> ServiceSpec:
        known = found.get(service.name)
        if known is None or is_stated(service):
            return service
        return replace(service, traffic=known.traffic)

    return replace(spec, services=tuple(carried(service) for service in spec.services))


def is_stated(service: ServiceSpec) -> bool:
    """Whether the pool file says what is asked of a service."""
    return service.traffic != TrafficSpec()
