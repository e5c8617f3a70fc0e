"""Run slow cloud calls outside the manager's loop; never two at once for one replica.

An operation stays in the list until its outcome is collected, so a caller that takes the list
*before* asking the cloud what exists misses nothing: an order is either still in the list
or already in the cloud's.

Not here: what to order (`reconciler`) and the threads (the `Prepare` that is passed in).
"""

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from fogft.errors import FogftError
from fogft.model.replica import ReplicaId

log = logging.getLogger(__name__)

Run = Callable[[], None]
Prepare = Callable[[Run], Callable[[], object]]  # returns what begins a run; OSError: nothing can
T = TypeVar("T")


@dataclass(frozen=True)
class Outcome(Generic[T]):
    """The outcome of an operation; `error` is None on success."""

    id: ReplicaId
    subject: T
    error: Exception | None


class Operations(Generic[T]):
    """Running operations, each for one replica; `on_done` is called when one ends."""

    def __init__(self, prepare: Prepare, on_done: Callable[[], None] = lambda: None) -> None:
        self._prepare = prepare
        self._on_done = on_done
        self._lock = threading.Lock()
        self._busy: dict[ReplicaId, T] = {}
        self._outcomes: list[Outcome[T]] = []

    def busy(self) -> Mapping[ReplicaId, T]:
        """Return the operations that are running, or have ended but are not collected."""
        with self._lock:
            return dict(self._busy)

    def collect(self) -> list[Outcome[T]]:
        """Return the outcomes since the last call; their replicas are free again."""
        with self._lock:
            outcomes, self._outcomes = self._outcomes, []
            for outcome in outcomes:
                del self._busy[outcome.id]
            return outcomes

    def start(self, id: ReplicaId, subject: T, run: Run, record: Run = lambda: None) -> bool:
        """Start an operation, or return False if this replica has one running.

        `record` is called once nothing else can prevent it. Raises OSError: no thread can start.
        """
        with self._lock:
            if id in self._busy:
                return False
        recorded = False
        begin = self._prepare(lambda: self._run(id, subject, run) if recorded else None)
        try:
            record()
            recorded = True
            with self._lock:
                self._busy[id] = subject
        finally:
            begin()
        return True

    def _run(self, id: ReplicaId, subject: T, operation: Callable[[], None]) -> None:
        error: Exception | None = None
        try:
            operation()
        except Exception as failed:
            if not isinstance(failed, FogftError):
                log.exception("operation_broke replica=%s", id.short)
            error = failed
        with self._lock:
            self._outcomes.append(Outcome(id, subject, error))
        del error  # its traceback holds this frame: break the reference cycle
        self._on_done()
