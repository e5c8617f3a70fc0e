"""Prometheus metrics of the proxies, from their reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from fogft.metrics.outcomes import BUCKETS_S, Outcome
from fogft.metrics.scrape import family, histogram

if TYPE_CHECKING:
    from prometheus_client import Metric

_OF_SERVICE = {
    "received": ("fogft_requests_total", "Requests that callers sent."),
    "sent": ("fogft_attempts_total", "Copies of requests that were sent to replicas."),
    "late": ("fogft_late_responses_total", "Responses that came too late to be used."),
    "request_bytes": ("fogft_request_bytes_total", "Bytes of all requests that callers sent."),
    "response_bytes": ("fogft_response_bytes_total", "Bytes of the first responses."),
    "rejected": ("fogft_rejected_responses_total", "Responses whose ok_field was false."),
    "undelivered": ("fogft_undelivered_responses_total", "Responses that ROS did not accept."),
    "fallback_failed": ("fogft_fallback_failures_total", "Fallback calls without a response."),
    "pending": ("fogft_pending_requests", "Requests without a response yet."),
}
LEASE = (
    "fogft_replica_lease_seconds",
    "Time until a replica shuts down if it hears from no manager.",
)
_OF_LINK = {
    "silent_for_s": ("fogft_link_silent_seconds", "Time since the oldest unanswered probe."),
    "rtt_s": ("fogft_link_round_trip_seconds", "Round trip of the last probe."),
    "in_flight": ("fogft_link_requests_in_flight", "Requests sent to a replica and not answered."),
    "lease_left_s": LEASE,
    "reopened": (
        "fogft_link_reconnects_total",
        "Times that the connection to a replica was reopened.",
    ),
    "restarts": ("fogft_replica_restarts_total", "Restarts of a replica's command."),
    "is_up": ("fogft_link_up", "Whether a replica answers probes."),
    "services": ("fogft_link_ready_services", "Services that a replica can answer."),
}
_WORK_COUNTS = {
    "ran": ("fogft_requests_run_total", "Requests passed on to a service."),
    "ran_s": ("fogft_request_run_seconds_total", "Time that services spent on requests."),
    "saved": (
        "fogft_requests_saved_total",
        "Requests dropped before they ran, as already answered elsewhere.",
    ),
    "interrupted": ("fogft_requests_interrupted_total", "Running requests that were cancelled."),
    "wasted": (
        "fogft_requests_wasted_total",
        "Requests completed although already answered elsewhere.",
    ),
    "wasted_s": ("fogft_request_wasted_seconds_total", "Time spent on those requests."),
}


def of_client(report: Mapping[str, Any]) -> Iterator[Metric]:
    """Yield the metrics of a client proxy or a gateway from its report."""
    yield from _requests(report["services"])
    links = [
        {**link, "is_up": link["state"] == "up", "services": len(link["ready"])}
        for link in _newest(report["links"])
    ]
    for key, (name, help) in _OF_LINK.items():
        known = (link for link in links if link.get(key) is not None)
        yield family(name, help, ((link[key], {"slot": str(link["slot"])}) for link in known))
    yield family(
        "fogft_topic_messages_total",
        "Messages of topics, by outcome.",
        (
            (count, {"topic": topic, "event": event})
            for topic, counts in report.get("topics", {}).items()
            for event, count in counts.items()
            if event not in ("trouble", "rate_hz")
        ),
    )
    yield family(
        "fogft_uplink_suspected",
        "Whether all links have fallen silent together.",
        [(report["uplink_suspected"], {})],
    )


def _requests(services: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    for key, (name, help) in _OF_SERVICE.items():
        known = {s: count[key] for s, count in services.items() if key in count}
        yield family(name, help, ((value, {"service": s}) for s, value in known.items()))
    yield family(
        "fogft_outcomes_total",
        "How requests ended.",
        (
            (count[outcome], {"service": s, "outcome": outcome})
            for s, count in services.items()
            for outcome in (one.value for one in Outcome)
            if outcome in count
        ),
    )
    yield family(
        "fogft_first_responses_total",
        "Requests that a replica answered first.",
        (
            (won, {"service": s, "slot": slot})
            for s, count in services.items()
            for slot, won in _by_slot(count.get("won", {})).items()
        ),
    )
    yield _refusals(
        (refused, {"service": s, "reason": reason})
        for s, count in services.items()
        for reason, refused in count.get("refused", {}).items()
    )
    yield histogram(
        "fogft_request_duration_seconds",
        "Time from a request to its first response.",
        BUCKETS_S,
        (
            (count["buckets"], count["took_s"], {"service": s})
            for s, count in services.items()
            if "buckets" in count
        ),
    )


def _refusals(values: Iterator[tuple[float, dict[str, str]]]) -> Metric:
    return family("fogft_refusals_total", "Copies of requests that were refused.", values)


def _by_slot(by_replica: Mapping[str, int]) -> Counter[str]:
    found: Counter[str] = Counter()
    for replica, count in by_replica.items():
        found[replica.partition(".")[0]] += count
    return found


def _newest(links: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return each slot's link of the newest generation: a series has only one sample."""
    ranked = sorted(links, key=lambda link: (link["generation"], link["state"] == "up"))
    return list({link["slot"]: link for link in ranked}.values())


def of_server(report: Mapping[str, Any]) -> Iterator[Metric]:
    """Yield the metrics of a server proxy from its report."""
    work: Mapping[str, float] = report["work"]
    yield family("fogft_requests_held", "Requests held and not yet answered.", [(work["held"], {})])
    for key, (name, help) in _WORK_COUNTS.items():
        yield family(name, help, [(work[key], {})])
    yield _refusals((count, {"reason": reason}) for reason, count in report["refused"].items())
    yield family(
        "fogft_concurrency_limit",
        "Requests that a service is given at the same time.",
        ((limit, {"service": name}) for name, limit in report["limits"].items()),
    )
    yield family(
        "fogft_service_ready",
        "Whether a service can answer.",
        ((ready, {"service": name}) for name, ready in report["services"].items()),
    )
    yield family(
        "fogft_replica_draining",
        "Whether this machine received a preemption notice.",
        [(report["draining"], {})],
    )
    yield family(
        "fogft_replica_restarts_total", "Restarts of the command.", [(report["restarts"], {})]
    )
    if report["lease_left_s"] is not None:
        yield family(*LEASE, [(report["lease_left_s"], {})])
    yield _listener(report["wire"])


def of_gateway(report: Mapping[str, Any]) -> Iterator[Metric]:
    """Yield the metrics of a gateway from its report."""
    forwarded = report["forwarded"]
    yield from of_client(report)
    yield family(
        "fogft_gateway_requests_in_flight",
        "Robots' requests being forwarded.",
        [(forwarded["in_flight"], {})],
    )
    yield by_event(
        "fogft_gateway_requests_total",
        "Robots' requests.",
        {key: forwarded[key] for key in ("passed", "joined")},
    )
    yield family(
        "fogft_gateway_refusals_total",
        "Robots' requests refused, by reason.",
        ((count, {"reason": reason}) for reason, count in forwarded["refused"].items()),
    )
    yield _listener(report["listener"])


def _listener(counts: Mapping[str, float]) -> Metric:
    return by_event("fogft_listener_events_total", "Events at the listening port.", counts)


def by_event(name: str, help: str, counts: Mapping[str, float]) -> Metric:
    """Return counters of one name, by event."""
    return family(name, help, ((n, {"event": str(event)}) for event, n in counts.items()))
