"""From the proxy's report and a tick to `status.json`, and back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import StateError
from fogft.metrics.outcomes import Outcomes
from fogft.model.intent import Intent
from fogft.model.plain import to_plain
from fogft.model.reason import Cause, Reason
from fogft.model.replica import LinkState, Observed, ReplicaId
from fogft.planning.observed.history import Event, EventKind, History
from fogft.planning.planner import plan
from fogft.planning.sizing import Inputs
from fogft.pool.folder.store import Identity
from fogft.pool.manager import proxy_report, status
from fogft.pool.manager.reconciler import Tick
from tests.planning.pool_worlds import NOW, UID, World, replica, spec

LINK = {"slot": 1, "generation": 2, "state": "up", "ready": ["/plan"]}
REPORT: dict[str, Any] = {
    "pid": 7,
    "written_at": 100.0,
    "uptime_s": 5.0,
    "robot": "r2",
    "links": [{**LINK, "won": 3, "rtt_s": 0.01, "in_flight": 1, "detail": "", "draining": False}],
    "services": {"/plan": {"received": 4, "answered": 3, "refused": {"not-ready": 1}}},
    "uplink_suspected": False,
}


def test_a_report_is_read_whole() -> None:
    """Links, counters and who wrote it."""
    report = proxy_report.parse(REPORT, UID)
    assert report is not None
    [link] = report.links
    assert (link.id, link.state) == (ReplicaId(UID, 1, 2), LinkState.UP)
    assert (link.ready, link.won, link.rtt_s) == (frozenset({"/plan"}), 3, 0.01)
    assert report.services["/plan"]["answered"] == 3


def test_the_phases_of_a_launch_are_told_as_far_as_they_are_known() -> None:
    base = replica(0, 1).machine
    for running_at, set_up_at, ready_at, told in (
        (0.0, 0.0, None, (None, None, None, None)),
        (NOW - 60, 0.0, None, (40.0, None, None, None)),
        (NOW - 60, NOW - 30, None, (40.0, 30.0, None, None)),
        (NOW - 60, NOW - 30, NOW - 10, (40.0, 30.0, 20.0, 90.0)),
        (0.0, 0.0, NOW - 10, (None, None, None, 90.0)),
    ):
        history = History([Event(NOW - 100, EventKind.LAUNCH, 0, 1, base.placement.location)])
        if ready_at:
            history.add(Event(ready_at, EventKind.READY, 0, 1))
        machine = replace(base, running_at=running_at, set_up_at=set_up_at)
        observed = Observed(NOW, (machine,))
        decided = plan(UID, Inputs(spec(), Intent(), observed, history))
        identity = Identity("pool", UID, "sky", "/pool.yaml", NOW)
        tick = Tick(identity, spec(), Intent(), observed, decided, None)
        seen = status.of_tick(tick, history=history, recent=[])
        [one] = seen.replicas
        assert (one.provisioning_s, one.setup_s, one.starting_s, one.ready_after_s) == told


def test_what_a_client_proxy_counts_is_read() -> None:
    """From its first moment on, and in order where a service has state."""
    fresh = {**Outcomes().report(), "pending": 0, "order": {"trouble": "a\nb", "last": None}}
    later = {**fresh, "poisoned_at": 1.7e9, "p50_s": 0.1, "p99_s": 0.2}
    for counted in (fresh, later):
        report = proxy_report.parse({**REPORT, "services": {"/plan": counted}}, UID)
        assert report is not None
        assert report.services["/plan"] == counted


@pytest.mark.parametrize(("now", "fresh"), [(100, True), (105, True), (106, False), (90, False)])
def test_an_old_report_says_nothing(now: float, fresh: bool) -> None:
    """Older than five seconds, or from the future of a clock that jumped: unknown."""
    report = proxy_report.parse(REPORT, UID)
    assert report is not None
    assert report.fresh(now) is fresh


@given(st.sampled_from(sorted(REPORT)), st.none() | st.integers() | st.text() | st.lists(st.none()))
def test_a_damaged_report_is_no_report(key: str, junk: object) -> None:
    """Whatever stands in the file, reading it raises nothing."""
    report = proxy_report.parse({**REPORT, key: junk}, UID)
    assert report is None or report.links == () or report.links[0].id.slot == 1


def test_the_digest_ignores_counters_and_sees_states() -> None:
    """A manager is woken by what matters, not by each request."""
    busy = {**REPORT, "links": [{**LINK, "won": 99, "in_flight": 5}]}
    down = {**REPORT, "links": [{**LINK, "state": "suspect"}]}
    late = {**REPORT, "links": [{**LINK, "silent_for_s": 0.7, "rtt_s": 0.01}]}
    later = {**REPORT, "links": [{**LINK, "silent_for_s": 1.7, "rtt_s": 0.01}]}
    digests = []
    for raw in (REPORT, busy, down, late, later):
        report = proxy_report.parse(raw, UID)
        assert report is not None
        digests.append(report.digest())
    assert digests[0] == digests[1] != digests[2]
    assert digests[0] != digests[3] == digests[4], "a late answer is told once"


def tick_of(world: World) -> Tick:
    identity = Identity("pool", UID, "mock", "/pool.yaml", NOW)
    return Tick(identity, world.spec, world.intent, world.observed, world.plan(), None)


def status_of(world: World, **others: Any) -> status.PoolStatus:
    seen = status.of_tick(
        tick_of(world),
        history=world.history,
        recent=[Event(NOW, EventKind.LAUNCH, 0, 1, "c/r/a", Reason(Cause.NEW_SLOT))],
        **others,
    )
    report = proxy_report.parse(REPORT, UID)
    return seen.joined(report, proxy_alive=True, links=world.observed.links)


def test_status_says_what_was_seen_and_survives_json() -> None:
    """Counts, phases, price, services and events, the same after a round trip."""
    world = World(spec(2)).having(
        replica(0), replica(1, state="noticed"), replica(2, outdated=True)
    )
    seen = status_of(world, notes=[Reason(Cause.TROUBLE, words="one more")])
    assert (seen.target, seen.ready, seen.proxy_pid) == (2, 2, 7)
    assert [r.phase for r in seen.replicas] == ["ready", "draining", "ready"]
    assert [r.detail for r in seen.replicas] == ["", "preemption notice", ""]
    assert seen.usd_per_hour == pytest.approx(0.3)
    assert seen.services[0].ready_replicas == 3
    assert seen.services[0].counters["answered"] == 3
    assert seen.notes[-1] == "one more"
    assert seen.reasons[-1] == Reason(Cause.TROUBLE, words="one more")
    assert [r.reason for r in seen.replicas] == [None, Reason(Cause.NOTICE), None]
    assert seen.events[0].event == "launched"
    again = status.from_json(json.loads(json.dumps(to_plain(seen))), Path("status.json"))
    assert to_plain(again) == json.loads(json.dumps(to_plain(seen)))


def test_marked_and_ending_replicas_show_as_draining() -> None:
    """What is to go is not counted as ready."""
    seen = status_of(World(spec(1)).having(replica(0), replica(1)))
    assert seen.ready == 1
    assert [r.phase for r in seen.replicas] == ["ready", "draining"]


def test_unknown_cloud_is_said() -> None:
    """Without the cloud's list there is no claim about replicas."""
    seen = status_of(World(spec(1), machines=None))
    assert not seen.cloud_reachable
    assert seen.replicas == []


def test_stopping_is_shown() -> None:
    """During `down` nothing is wanted."""
    seen = status_of(World(spec(1), intent=Intent(stopping=True)).having(replica(0)))
    assert (seen.stopping, seen.target) == (True, 0)


@pytest.mark.parametrize("junk", [None, [], {}, {"replicas": [{"slot": 1}], "services": []}])
def test_what_is_no_status_is_an_error(junk: object) -> None:
    """A reader of another version is told so."""
    with pytest.raises(StateError):
        status.from_json(junk, Path("status.json"))
