"""`wait_for_service` tells the truth, but for a moment's silence and for requests that wait."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.choices import FallbackSpec
from fogft.model.spec import Advertise, OnTimeout, ServiceSpec
from fogft.proxy.robot.proxied_service import HOLD_S, ProxiedService

SPEC = ServiceSpec("/s", "a/srv/A", timeout_s=10.0)
steps = st.lists(st.tuples(st.booleans(), st.integers(0, 2), st.floats(0, 20)), max_size=40)


class Scene:
    """A service in ROS, whose dispatcher says what the test says."""

    def __init__(self, spec: ServiceSpec) -> None:
        self._service = ProxiedService(spec, Mock())

    def offered(self, *, able: bool, waiting: int, now: float) -> bool:
        self._service.dispatcher.able, self._service.dispatcher.waiting = able, waiting
        self._service.advertise(Mock(), now)
        return self._service.server is not None


def run(spec: ServiceSpec, steps):
    """Yield, after each step, what it was told and whether the service is offered."""
    scene, now = Scene(spec), 0.0
    for able, waiting, passed in steps:
        now += passed
        yield able, now, scene.offered(able=able, waiting=waiting, now=now)


@given(steps)
def test_what_can_be_answered_is_offered(steps):
    assert all(offered for able, _, offered in run(SPEC, steps) if able)


@given(steps)
def test_nothing_is_offered_before_the_first_replica(steps):
    seen = False
    for able, _, offered in run(SPEC, steps):
        seen = seen or able
        assert seen or not offered


@given(steps)
def test_what_nobody_answered_for_long_is_not_offered(steps):
    """However many requests come in, it is withdrawn at the latest `timeout_s` after the hold."""
    unable_since = None
    for able, now, offered in run(SPEC, steps):
        unable_since = None if able else now if unable_since is None else unable_since
        if unable_since is not None and now >= unable_since + HOLD_S + SPEC.timeout_s:
            assert not offered


@given(steps)
def test_once_ready_is_never_withdrawn(steps):
    offered_before = False
    for _, _, offered in run(replace(SPEC, advertise=Advertise.ONCE_READY), steps):
        assert offered or not offered_before
        offered_before = offered


def test_a_request_that_waits_keeps_it_until_its_deadline():
    scene = Scene(SPEC)
    assert scene.offered(able=True, waiting=0, now=0.0)
    assert scene.offered(able=False, waiting=1, now=1.0)
    assert scene.offered(able=False, waiting=1, now=1.0 + HOLD_S)
    assert not scene.offered(able=False, waiting=0, now=1.0 + HOLD_S)


def test_a_lone_replica_that_comes_back_soon_was_never_away():
    scene = Scene(SPEC)
    assert scene.offered(able=True, waiting=0, now=0.0)
    assert scene.offered(able=False, waiting=0, now=1.0)
    assert scene.offered(able=True, waiting=0, now=2.0)
    assert scene.offered(able=False, waiting=0, now=2.0 + HOLD_S)


def test_always_is_from_the_start():
    spec = replace(SPEC, advertise=Advertise.ALWAYS)
    assert Scene(spec).offered(able=False, waiting=0, now=0.0)


@pytest.mark.parametrize(
    ("spec", "usual"),
    [
        (SPEC, Advertise.WHILE_READY),
        (replace(SPEC, on_timeout=OnTimeout.EMPTY), Advertise.ONCE_READY),
        (replace(SPEC, on_timeout=OnTimeout.FALLBACK, fallback=FallbackSpec("/f")),
         Advertise.ONCE_READY),
        (replace(SPEC, on_timeout=OnTimeout.EMPTY, advertise=Advertise.WHILE_READY),
         Advertise.WHILE_READY),
    ],
)  # fmt: skip
def test_what_is_answered_without_replicas_stays_unless_told(spec, usual):
    assert spec.advertised is usual
