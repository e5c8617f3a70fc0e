"""Calls have a limit, and a server that is slow is not asked the same again meanwhile."""

from __future__ import annotations

import threading

import pytest

from fogft.cloud.sky.installed import InstalledSky
from fogft.cloud.sky.kept import Kept
from fogft.cloud.sky.sdk import RefusedError
from fogft.errors import CloudError, CloudUnreachable
from fogft.process import on_thread
from tests.fakes.threads import no_more
from tests.fakes.waiting import wait_for


class ApiServerConnectionError(RuntimeError):
    """Named as SkyPilot's."""


class ClusterNotUpError(Exception):
    """Named as SkyPilot's."""


def test_an_answer_in_time_is_returned():
    calls = InstalledSky()
    with no_more(), pytest.raises(CloudUnreachable, match="thread"):
        calls.within(30, "x", lambda: 7)
    assert calls.within(30, "x", lambda: 7) == 7


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (ApiServerConnectionError("refused"), CloudUnreachable),
        (ConnectionResetError("reset"), CloudUnreachable),
        (RuntimeError("Failed to get request 1: 500"), CloudUnreachable),
        (ClusterNotUpError("not up"), RefusedError),
        (RuntimeError("something else"), RefusedError),
        (SystemExit(1), RefusedError),
        (CloudError("ours"), CloudError),
    ],
)
def test_errors_become_ours(error: BaseException, expected: type[CloudError]):
    """Nothing of SkyPilot's passes this line, and "nobody knows" stays apart from "no"."""

    def fail() -> None:
        raise error

    with pytest.raises(CloudError) as caught:
        InstalledSky().within(30, "x", fail)
    assert type(caught.value) is expected


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, in one element, which passes when a test says so."""
    now = [1000.0]
    monkeypatch.setattr("fogft.cloud.sky.installed.time.monotonic", lambda: now[0])
    return now


def test_a_call_without_an_answer_is_given_up_and_not_repeated_while_it_runs(now: list[float]):
    """However often it is asked again, one call of a subject is under way."""
    calls, begun, go_on = InstalledSky(), threading.Semaphore(0), threading.Event()

    def hang() -> str:
        begun.release()
        go_on.wait(60)
        return "late"

    for _ in range(4):
        with pytest.raises(CloudUnreachable, match="did not answer"):
            calls.within(0.02, "x", hang)
        now[0] += 0.02
    assert begun.acquire(timeout=30)
    assert not begun.acquire(blocking=False), "it was asked once"
    assert calls.within(30, "y", lambda: "other") == "other"
    go_on.set()
    assert calls.within(30, "x", lambda: "fresh") == "fresh", "a late answer is thrown away"


def test_a_call_whose_answer_must_have_been_lost_on_the_way_is_made_anew(now: list[float]):
    """SkyPilot's client waits without end on a connection that a router has forgotten."""
    calls, go_on, asked = InstalledSky(), threading.Event(), threading.Semaphore(0)

    def hang() -> str:
        asked.release()
        go_on.wait(60)
        return "late"

    for _ in range(2):
        for _ in range(3):
            with pytest.raises(CloudUnreachable, match="did not answer"):
                calls.within(0.02, "x", hang)
        assert asked.acquire(timeout=30)
        assert not asked.acquire(blocking=False), "the new one has its own time"
        now[0] += 1.0
    go_on.set()


@pytest.mark.parametrize("set_s", [3600.0, -3600.0])
def test_an_answer_is_old_where_the_clock_was_set(set_s: float):
    now, asked = [1000.0], []
    kept = Kept(lambda: asked.append(1), 5.0, 15.0, lambda: now[0], lambda run: run(), failed=print)
    kept.answer = kept.renew() or ()
    now[0] += set_s
    kept.get()
    assert len(asked) == 2


def test_a_renewal_without_a_thread_is_made_up_for_once_the_answer_is_too_old():
    now, asked = [1000.0], []
    kept = Kept(lambda: asked.append(1) or 1, 5.0, 15.0, lambda: now[0], on_thread, failed=print)
    kept.get()
    now[0] += 6.0
    with no_more(), pytest.raises(OSError, match="thread"):
        kept.get()
    now[0] += 10.0
    kept.get()
    assert len(asked) == 2
    now[0] += 6.0
    kept.get()
    wait_for(lambda: len(asked) == 3)


def test_what_was_asked_before_it_was_to_be_forgotten_is_asked_again():
    """SkyPilot's list is long under way: a replica that ended meanwhile would be listed again."""
    machines = ["0.1"]

    def ask() -> list[str]:
        listed = list(machines)
        if machines:
            machines.clear()
            kept.forget()
        return listed

    kept = Kept(ask, 5.0, 15.0, lambda: 1000.0, lambda run: run(), failed=lambda _: None)
    assert kept.get() == ["0.1"]
    assert kept.get() == []
