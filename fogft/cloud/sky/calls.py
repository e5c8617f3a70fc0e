"""Give calls of SkyPilot's a limit, though its client has none.

A call that is given up still runs, here and on the API server. Until it has ended the same
question is not asked again, so that a slow server is not buried under repetitions; its late
answer is thrown away, since it may be older than what the next asker wants to know.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

from fogft.cloud.sky.answers import translated
from fogft.errors import CloudUnreachable

T = TypeVar("T")


class Calls:
    """Runs calls, and remembers those that were given up, by subject."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._given_up: dict[str, threading.Thread] = {}

    def within(self, limit_s: float, subject: str, call: Callable[[], T]) -> T:
        """Run a call, for so long at most; turn its errors into ours.

        Args:
            limit_s: How long to wait, in seconds.
            subject: What it is about, in words; the same words are the same question.
            call: What to run, on a thread of its own.

        Raises:
            CloudUnreachable: No answer in time, or none that says anything.
            RefusedError: The answer is no.
        """
        end = time.monotonic() + limit_s
        with self._lock:
            before = self._given_up.get(subject)
        if before is not None:
            before.join(limit_s)
        outcome: list[T] = []
        errors: list[BaseException] = []

        def run() -> None:
            try:
                outcome.append(call())
            except BaseException as error:  # SystemExit too: SkyPilot's client uses it
                errors.append(error)

        thread = before
        if before is None or not before.is_alive():
            thread = threading.Thread(target=run, name="sky-call", daemon=True)
            thread.start()
            thread.join(max(0.0, end - time.monotonic()))
        assert thread is not None
        with self._lock:
            if thread.is_alive():
                self._given_up[subject] = thread
            else:
                self._given_up.pop(subject, None)
        if outcome:
            return outcome[0]
        if errors:
            raise translated(errors[0], subject) from errors[0]
        raise CloudUnreachable(
            f"SkyPilot did not answer within {limit_s:.0f} s about {subject}",
            "`sky api info` and `sky api logs` tell how its API server is doing",
        )
