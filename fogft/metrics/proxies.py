"""What the proxies tell Prometheus, made of what they report. Pure.

Owns: names and labels of the metrics. Not here: counting (`outcomes`, `responder`), the text
(`metrics.exposition`), serving it (`fogft.metrics.scrape`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from fogft.metrics.exposition import COUNTER, GAUGE, HISTOGRAM, Family, Sample, histogram, of
from fogft.metrics.outcomes import BUCKETS_S

# How requests end. `pending` is the rest.
OUTCOMES = ("answered", "fallback", "empty", "silent", "turned_away", "cancelled")
_COUNTS = {
    "received": ("fogft_requests_total", "Requests that callers sent."),
    "sent": ("fogft_copies_total", "Copies of requests that were sent to replicas."),
    "late": ("fogft_late_answers_total", "Answers that came too late to be used."),
    "request_bytes": ("fogft_request_bytes_total", "Bytes of all requests that callers sent."),
    "response_bytes": ("fogft_response_bytes_total", "Bytes of the first answers of replicas."),
    "rejected": ("fogft_rejected_answers_total", "Responses whose ok_field was false."),
    "undelivered": ("fogft_undelivered_responses_total", "Responses that ROS did not take."),
    "fallback_failed": ("fogft_fallback_failed_total", "Calls of a fallback that gave nothing."),
}
_LINK_GAUGES = {
    "silent_for_s": ("fogft_link_silent_seconds", "Since a probe is unanswered."),
    "rtt_s": ("fogft_link_round_trip_seconds", "Round trip of the last probe."),
    "in_flight": ("fogft_link_requests_in_flight", "Requests under way to a replica."),
}
_LINK_COUNTS = {
    "reopened": (
        "fogft_link_reopened_total",
        "Connections to a replica that had to be opened anew.",
    ),
    "restarts": ("fogft_replica_restarts_total", "Restarts of a replica's command."),
}
_WORK_GAUGES = {"held": ("fogft_requests_held", "Requests that are held and not yet answered.")}
_WORK_COUNTS = {
    "ran": ("fogft_requests_run_total", "Requests that were passed on to a service."),
    "ran_s": ("fogft_request_run_seconds_total", "Time that services took for them."),
    "saved": ("fogft_requests_saved_total", "Requests dropped unbegun: answered elsewhere."),
    "interrupted": ("fogft_requests_interrupted_total", "Requests at work that were told to stop."),
    "wasted": ("fogft_requests_wasted_total", "Requests that were run for nobody."),
    "wasted_s": ("fogft_request_wasted_seconds_total", "Time that those took."),
}


def of_client(report: Mapping[str, Any]) -> list[Family]:
    """Return the metrics of a client proxy or a gateway from its report."""
    services, links = report["services"], report["links"]
    return [
        *_requests(services),
        *(_of_links(links, key, GAUGE, *told) for key, told in _LINK_GAUGES.items()),
        *(_of_links(links, key, COUNTER, *told) for key, told in _LINK_COUNTS.items()),
        of("fogft_link_up", GAUGE, "Whether a replica answers probes.",
           (Sample(link["state"] == "up", {"replica": _who(link)}) for link in links)),
        of("fogft_link_ready_services", GAUGE, "Services that a replica can answer.",
           (Sample(len(link["ready"]), {"replica": _who(link)}) for link in links)),
        of("fogft_topic_messages_total", COUNTER, "Messages of topics, and what became of them.", (
            Sample(count, {"topic": topic, "event": event})
            for topic, counts in report.get("topics", {}).items()
            for event, count in counts.items() if event != "trouble"
        )),
        of("fogft_uplink_suspected", GAUGE, "Whether all links have fallen silent together.",
           [Sample(report["uplink_suspected"])]),
    ]  # fmt: skip


def _requests(services: Mapping[str, Mapping[str, Any]]) -> Iterator[Family]:
    for key, (name, help) in _COUNTS.items():
        yield of(name, COUNTER, help, (
            Sample(count[key], {"service": s}) for s, count in services.items() if key in count
        ))  # fmt: skip
    yield of("fogft_outcomes_total", COUNTER, "How requests ended.", (
        Sample(count[outcome], {"service": s, "outcome": outcome})
        for s, count in services.items() for outcome in OUTCOMES if outcome in count
    ))  # fmt: skip
    yield of("fogft_answers_total", COUNTER, "Requests that a replica answered first.", (
        Sample(won, {"service": s, "replica": replica})
        for s, count in services.items() for replica, won in count.get("won", {}).items()
    ))  # fmt: skip
    yield of("fogft_refusals_total", COUNTER, "Copies that replicas refused, by reason.", (
        Sample(refused, {"service": s, "reason": reason})
        for s, count in services.items() for reason, refused in count.get("refused", {}).items()
    ))  # fmt: skip
    yield of("fogft_pending_requests", GAUGE, "Requests without an answer yet.", (
        Sample(count["pending"], {"service": s}) for s, count in services.items()
        if "pending" in count
    ))  # fmt: skip
    yield of("fogft_request_seconds", HISTOGRAM, "From a request to its first answer.", (
        sample for s, count in services.items() if "buckets" in count
        for sample in histogram(BUCKETS_S, count["buckets"], count["took_s"], {"service": s})
    ))  # fmt: skip


def _of_links(links: list[Mapping[str, Any]], key: str, kind: str, name: str, help: str) -> Family:
    known = (link for link in links if link.get(key) is not None)
    return of(name, kind, help, (Sample(link[key], {"replica": _who(link)}) for link in known))


def _who(link: Mapping[str, Any]) -> str:
    return f"{link['slot']}.{link['generation']}"


def of_server(report: Mapping[str, Any]) -> list[Family]:
    """Return the metrics of a server proxy from its report."""
    work: Mapping[str, float] = report["work"]
    return [
        *(of(name, GAUGE, help, [Sample(work[key])]) for key, (name, help) in _WORK_GAUGES.items()),
        *(of(name, COUNTER, help, [Sample(work[k])]) for k, (name, help) in _WORK_COUNTS.items()),
        of("fogft_refusals_total", COUNTER, "Requests that were refused, by reason.",
           (Sample(count, {"reason": reason}) for reason, count in report["refused"].items())),
        of("fogft_concurrency_limit", GAUGE, "Requests that a service is given at once.",
           (Sample(limit, {"service": name}) for name, limit in report["limits"].items())),
        of("fogft_service_ready", GAUGE, "Whether a service can answer.",
           (Sample(ready, {"service": name}) for name, ready in report["services"].items())),
        of("fogft_draining", GAUGE, "Whether the machine will be taken.",
           [Sample(report["draining"])]),
        of("fogft_replica_restarts_total", COUNTER, "Restarts of the command.",
           [Sample(report["restarts"])]),
        counted("fogft_wire_events_total", "Events at the listening port.", report["wire"]),
    ]  # fmt: skip


def of_gateway(report: Mapping[str, Any]) -> list[Family]:
    """Return the metrics of a gateway from its report."""
    forwarded = report["forwarded"]
    return [
        *of_client(report),
        of("fogft_gateway_held", GAUGE, "Robots' requests under way.",
           [Sample(forwarded["in_flight"])]),
        counted("fogft_gateway_requests_total", "Robots' requests.",
                {key: forwarded[key] for key in ("passed", "joined")}),
        of("fogft_gateway_refusals_total", COUNTER, "Robots' requests refused, by reason.",
           (Sample(count, {"reason": reason}) for reason, count in forwarded["refused"].items())),
        counted("fogft_wire_events_total", "Events at the listening port.", report["listener"]),
    ]  # fmt: skip


def counted(name: str, help: str, counts: Mapping[str, float]) -> Family:
    """Return a family of counters by event."""
    return of(name, COUNTER, help, (Sample(n, {"event": event}) for event, n in counts.items()))
