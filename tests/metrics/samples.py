"""A report of every kind of process, each with something in every part, and its metrics."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from prometheus_client import Metric, generate_latest

from fogft.metrics import proxies
from fogft.metrics.outcomes import BUCKETS_S, OUTCOMES_COUNTED
from fogft.metrics.scrape import Labels, Scrape
from fogft.model.reason import Cause, Reason
from fogft.planning.observed.history import Event, EventKind
from fogft.pool.manager.tally import Tally, of_pool, of_rendezvous
from tests.fakes.pools import STATUS

SERVICE = {
    **dict.fromkeys(OUTCOMES_COUNTED, 3),
    "type": "a/srv/B",
    "poisoned_at": 1.7e9,
    "pending": 1,
    "refused": {"crashed": 2},
    "won": {"0.1": 4, "0.2": 5, "1.1": 6},
    "buckets": [1] * (len(BUCKETS_S) + 1),
    "took_s": 12.5,
}
LINK = {
    "slot": 0,
    "generation": 1,
    "state": "up",
    "ready": ["/s"],
    "silent_for_s": 0.0,
    "rtt_s": 0.01,
    "in_flight": 2,
    "reopened": 1,
    "restarts": 0,
    "lease_left_s": 86_000.0,
}
CLIENT = {
    "services": {"/s": SERVICE},
    "links": [LINK, {**LINK, "slot": 1, "rtt_s": None}],
    "topics": {"/t": {"passed": 5, "dropped": 1, "trouble": ""}},
    "uplink_suspected": False,
}
SERVER = {
    "work": dict.fromkeys(
        ("held", "ran", "ran_s", "saved", "interrupted", "wasted", "wasted_s"), 1
    ),
    "refused": {"overloaded": 1},
    "limits": {"/s": 4},
    "services": {"/s": True},
    "draining": False,
    "lease_left_s": 86_000.0,
    "restarts": 1,
    "wire": {"requests": 3},
}
GATEWAY = {
    **CLIENT,
    "forwarded": {"in_flight": 1, "passed": 3, "joined": 1, "refused": {"overloaded": 1}},
    "listener": {"requests": 3},
}
RENDEZVOUS = {
    "callers": 2,
    "records": 5,
    "port": {"refused": 1},
    "messages": {"hello": 1},
    "offered": {"new": 1},
}
POOL = {"pool": "p"}
KEYS_END = replace(STATUS, credentials_end_at=3600.0)


def text(families: Iterable[Metric], labels: Labels) -> str:
    """Return families in Prometheus's text format, as a scraper gets them."""
    return generate_latest(Scrape(lambda: families, labels)).decode()


def tally() -> Tally:
    """Return what a manager counts that has launched, lost and failed."""
    counted, lost = Tally(), Reason(Cause.REPLACES, because=(Reason(Cause.NOTICE),), replica="0.1")
    capacity, setup = Reason(Cause.CAPACITY), Reason(Cause.SETUP)
    for event in (
        Event(0.0, EventKind.LAUNCH, 0, 1),
        Event(40.0, EventKind.READY, 0, 1),
        Event(50.0, EventKind.LAUNCH, 0, 2, reason=lost, on_demand=True),
        Event(55.0, EventKind.GONE, 0, 1),
        Event(60.0, EventKind.REFUSED, 1, 1, reason=capacity),
        Event(90.0, EventKind.FAILED, 0, 2, reason=setup),
        Event(95.0, EventKind.GONE, 0, 2),
    ):
        counted.heard(event)
    return counted


PROCESSES = {
    "client proxy": lambda: text(proxies.of_client(CLIENT), POOL),
    "server proxy": lambda: text(proxies.of_server(SERVER), {**POOL, "slot": "0"}),
    "gateway": lambda: text(proxies.of_gateway(GATEWAY), POOL),
    "manager": lambda: text(of_pool(KEYS_END, tally()), POOL),
    "rendezvous": lambda: text(of_rendezvous(RENDEZVOUS), {"pool_uid": "0123456789012345"}),
}
