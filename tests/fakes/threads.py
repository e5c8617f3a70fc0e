"""Threads that meet where they seldom would: side by side, or one in the midst of another."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest

from tests.fakes.waiting import wait_for


@contextlib.contextmanager
def no_more() -> Iterator[None]:
    """Let no thread be started, as where the system allows no more of them."""

    def start(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with pytest.MonkeyPatch.context() as full:
        full.setattr(threading.Thread, "start", start)
        yield


@contextlib.contextmanager
def often() -> Iterator[None]:
    """Let each thread run for but a microsecond at a time."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)


def at_once(*steps: Callable[[], object]) -> None:
    """Run steps on a thread each, which take turns at every chance; raise what one raises."""
    together = Barrier(len(steps))

    def run(step: Callable[[], object]) -> None:
        together.wait()
        step()

    with often(), ThreadPoolExecutor(len(steps)) as threads:
        for done in [threads.submit(run, step) for step in steps]:
            done.result()


def meanwhile(changes: Callable[[], object], look: Callable[[], object]) -> None:
    """Have this thread `look` again and again until another one has made its `changes`."""
    with often(), ThreadPoolExecutor(1) as other:
        changing = other.submit(changes)
        while not changing.done():
            look()
        changing.result()


def waits_for(lock: Path) -> bool:
    """Whether somebody waits for a lock, by the kernel's list."""
    inode = lock.stat().st_ino if lock.exists() else -1
    lines = Path("/proc/locks").read_text().splitlines()
    return any("->" in line and f":{inode} " in line for line in lines)


def amid(threads: ThreadPoolExecutor, step: Callable[[], object], lock: Path) -> Future[object]:
    """Run a step on another thread until it is done, or waits for a lock."""
    running = threads.submit(step)
    wait_for(lambda: running.done() or waits_for(lock))
    return running
