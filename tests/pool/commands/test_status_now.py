"""What is known of a pool now: never what was true once."""

from __future__ import annotations

import os
import subprocess
import time
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft import disk
from fogft.model.replica import LinkReport, LinkState, ReplicaId
from fogft.pool.commands.status import STALE_AFTER_S, Seen, current, read
from fogft.pool.manager.proxy_report import STALE_S, ProxyReport
from tests.fakes.pools import REPLICA, STATUS, UID, alive, lay_down, report

NOW = 1_000_000.0
PLAN, DETECT = "/plan", "/detect"
names = st.frozensets(st.sampled_from([PLAN, DETECT]))
made_links = st.lists(
    st.builds(
        LinkReport,
        st.builds(ReplicaId, st.just(UID), st.integers(0, 2), st.just(1)),
        st.sampled_from(LinkState),
        names,
        draining=st.booleans(),
        heard_age_s=st.none() | st.floats(0, 100),
        rtt_s=st.none() | st.floats(0, 1),
        won=st.integers(0, 5),
    ),
    unique_by=lambda link: link.id,
    max_size=3,
).map(tuple)
ages = st.floats(0, 200)
statuses = st.builds(
    lambda phases, age_s: replace(
        STATUS,
        observed_at=NOW - age_s,
        services=(
            replace(STATUS.services[0], name=PLAN),
            replace(STATUS.services[0], name=DETECT),
        ),
        replicas=tuple(
            replace(REPLICA, slot=slot, phase=phase) for slot, phase in enumerate(phases)
        ),
    ),
    st.lists(st.sampled_from(["provisioning", "starting", "ready", "draining"]), max_size=3),
    ages,
)


def seen(status, links, report_age_s=0.5, *, manager=True, proxy=True, since=None) -> Seen:
    report = ProxyReport(1, NOW - report_age_s, links=links)
    return current(
        status, report, manager_alive=manager, proxy_alive=proxy, now=NOW, heard_since=since
    )


@given(statuses, made_links, ages, st.booleans())
def test_without_a_client_proxy_nothing_is_ready_and_nothing_answers(status, links, age_s, manager):
    """Whatever the manager saw, and however fresh the last report is."""
    found = seen(status, links, age_s, manager=manager, proxy=False)
    assert found.answers is False
    assert found.status.ready == 0
    assert all(one.link == "" and one.rtt_s is None for one in found.status.replicas)
    assert not any(one.known and one.phase == "ready" for one in found.status.replicas)


@given(statuses, made_links, st.floats(STALE_S + 0.1, 200))
def test_of_a_client_proxy_that_hangs_nothing_is_claimed(status, links, age_s):
    """It holds its lock and does not report: requests may be answered, or not."""
    found = seen(status, links, age_s)
    assert found.answers is None
    assert found.unanswered == ()
    assert found.status.ready == 0
    assert all(one.link == "" for one in found.status.replicas)


@given(statuses, made_links)
def test_the_last_report_of_a_proxy_that_was_killed_says_nothing_of_the_next(status, links):
    report = ProxyReport(1, NOW - 0.5, links=links)
    found = current(status, report, manager_alive=True, proxy_alive=True, succeeded=True, now=NOW)
    assert (found.answers, found.unanswered, found.links_known) == (None, (), False)
    assert found.status.ready == 0


ENDED = 1 << 30  # no process has this number


@pytest.mark.parametrize(
    ("said", "pid", "known"),
    [
        (os.getpid(), os.getpid(), True),
        (os.getpid(), os.getppid(), True),  # which hands over, and serves on for a while
        (os.getpid(), ENDED, False),
        (ENDED, ENDED, True),  # of a container, which counts processes by itself
        ("", ENDED, True),  # it had no room to say anything
    ],
    ids=["its own", "handing over", "ended", "in a container", "no room"],
)
def test_whose_report_is_believed(tmp_path, said, pid, known):
    paths = lay_down(tmp_path)
    with alive(paths):
        report(paths)
        written = disk.read_json(paths.proxy_status)
        disk.write_json(paths.proxy_status, {**written, "pid": pid})
        paths.proxy_lock.write_text(str(said))
        assert read(paths, time.time()).links_known is known


@given(statuses, made_links)
def test_a_service_is_answered_where_a_link_that_is_up_offers_it(status, links):
    """And a pool answers where each of its services is."""
    found = seen(status, links)
    offered = {n for link in links if link.state is LinkState.UP for n in link.ready}
    assert set(found.unanswered) == {PLAN, DETECT} - offered
    assert found.answers is (offered == {PLAN, DETECT})
    for service in found.status.services:
        ready = [k for k in links if k.state is LinkState.UP and service.name in k.ready]
        assert service.ready_replicas == len(ready)


@given(statuses, made_links)
def test_what_a_manager_saw_long_ago_is_not_shown_as_now(status, links):
    """Of a stale status no phase is known but one that the replica's own link tells."""
    found = seen(replace(status, observed_at=NOW - STALE_AFTER_S - 1), links)
    up = {k.id.slot for k in links if k.state is LinkState.UP and k.ready}
    assert {one.slot for one in found.status.replicas if one.known} <= up


@given(statuses, made_links, st.floats(0, 10))
def test_a_link_counts_only_if_it_was_heard_since_it_was_asked(status, links, before_s):
    """A probe that was answered before is no answer to this one."""
    found = seen(status, links, since=NOW - before_s)
    heard = {
        k.id.slot
        for k in links
        if k.state is LinkState.UP
        and k.heard_age_s is not None
        and NOW - 0.5 - k.heard_age_s >= NOW - before_s
    }
    assert {one.slot for one in found.status.replicas if one.link == "up"} <= heard


def test_a_replica_is_ready_as_soon_as_its_link_says_so():
    """Not only when the manager has looked again: `up` returns with the first answer."""
    starting = replace(STATUS, observed_at=NOW - 1, replicas=(replace(REPLICA, phase="starting"),))
    link = LinkReport(ReplicaId(UID, 0, 1), LinkState.UP, frozenset({PLAN}))
    found = seen(starting, (link,))
    assert (found.answers, found.status.ready) == (True, 1)
    assert [one.phase for one in found.status.replicas] == ["ready"]


@pytest.mark.parametrize("report", [None, ProxyReport(1, NOW - 78.0)])
def test_all_died_and_nothing_is_said_to_run(report):
    """The state of a pool 78 s after each of its processes was killed."""
    found = current(
        replace(STATUS, observed_at=NOW - 78.0, ready=3),
        report,
        manager_alive=False,
        proxy_alive=False,
        now=NOW,
    )
    assert (found.answers, found.status.ready, found.status.proxy_alive) == (False, 0, False)
    assert not any(one.known for one in found.status.replicas)
    assert found.to_json()["unanswered"] == [PLAN]


def test_the_report_of_a_proxy_that_nobody_has_waited_for_is_not_believed(tmp_path):
    """It was killed, and is a zombie: its parent was killed before it."""
    paths = lay_down(tmp_path)
    with alive(paths), subprocess.Popen(["true"]) as zombie:
        os.waitid(os.P_PID, zombie.pid, os.WEXITED | os.WNOWAIT)
        report(paths)
        written = disk.read_json(paths.proxy_status)
        disk.write_json(paths.proxy_status, {**written, "pid": zombie.pid})
        assert not read(paths, time.time()).links_known
