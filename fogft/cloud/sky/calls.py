"""Calls to SkyPilot with a time limit, which its client lacks.

A call that is given up still runs, here and on the API server. Until it has ended the same
question is not asked again, so that a slow server is not buried under repetitions; its late
answer is thrown away, since it may be older than what the next asker wants to know.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any, TypeVar

from fogft.cloud.sky.sdk import translated
from fogft.errors import CloudUnreachable

T = TypeVar("T")


class Calls:
    """Runs calls, and remembers those that timed out, by subject."""

    def __init__(self) -> None:
        self._given_up: dict[str, Future[Any]] = {}

    def within(self, limit_s: float, subject: str, call: Callable[[], T]) -> T:
        """Run a call on its own thread within a limit; `subject` tells which question it is."""
        ends_at = time.monotonic() + limit_s
        running = self._given_up.get(subject)
        if running is not None:
            wait([running], limit_s)
        if running is None or running.done():
            running = Future()
            threading.Thread(target=_run, args=(call, running), daemon=True).start()
            wait([running], max(0.0, ends_at - time.monotonic()))
            if running.done():
                self._given_up.pop(subject, None)
                error = running.exception()
                if error is not None:
                    raise translated(error, subject) from error
                answer: T = running.result()
                return answer
        self._given_up[subject] = running
        raise CloudUnreachable(
            f"SkyPilot did not answer within {limit_s:.0f} s about {subject}",
            "`sky api info` and `sky api logs` show the state of its API server",
        )


def _run(call: Callable[[], T], outcome: Future[T]) -> None:
    try:
        outcome.set_result(call())
    except BaseException as error:  # SystemExit too: SkyPilot's client uses it
        outcome.set_exception(error)
