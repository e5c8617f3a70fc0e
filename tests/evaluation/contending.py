"""A second, periodic client of the replicas' machines, beside the pool: compute contention.

It asks the service on each machine directly, in that machine's own ROS domain, as any other
client of a shared machine would; the pool knows nothing of it.

Owns: when it asks whom. Not here: which machines (`segmentation`).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

from tests.evaluation.caller import Caller

LIMIT_S = 120.0


class Contender:
    """Asks machines in turns, one request a period, while it is told to.

    Args:
        domains: The machines' ROS domains, by a name for each.
        services: What each machine's service is called.
        type: The service's type.
        request: What it asks for, each time.
    """

    def __init__(
        self, domains: dict[str, int], services: dict[str, str], type: Any, request: Any
    ) -> None:
        self._services, self._type, self._request = services, type, request
        self._callers = {n: Caller(d, f"contender_{i}") for i, (n, d) in enumerate(domains.items())}
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._open: list[threading.Thread] = []
        self._beat: threading.Thread | None = None
        self._busy: dict[str, int] = dict.fromkeys(domains, 0)

    def __enter__(self) -> Contender:
        for name, caller in self._callers.items():
            caller.wait(self._services[name], self._type)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        for caller in self._callers.values():
            caller.close()

    def begin(self, turns: Sequence[str | None], period_s: float) -> None:
        """Ask one machine of `turns` after the other, from now on; None: nobody of ours."""
        self._stop.clear()
        self._beat = threading.Thread(target=self._run, args=(turns, period_s), daemon=True)
        self._beat.start()

    def stop(self) -> None:
        """Ask no more, and wait for the answers."""
        self._stop.set()
        if self._beat is not None:
            self._beat.join()
            self._beat = None
        for thread in self._open:
            thread.join()
        self._open = []

    def busy(self, machines: Sequence[str]) -> int:
        """Return how many of these machines work for it now."""
        with self._lock:
            return sum(self._busy[name] > 0 for name in machines)

    def ask(self, machine: str, request: Any) -> Any:
        """Ask one machine; return its answer, which comes when all before has been answered."""
        return self._callers[machine].call(self._services[machine], self._type, request, LIMIT_S)[0]

    def _run(self, turns: Sequence[str | None], period_s: float) -> None:
        turn = 0
        while not self._stop.is_set():
            machine = turns[turn % len(turns)]
            if machine is not None:
                with self._lock:
                    self._busy[machine] += 1
                thread = threading.Thread(target=self._contend, args=(machine,), daemon=True)
                self._open.append(thread)
                thread.start()
            turn += 1
            self._stop.wait(period_s)

    def _contend(self, machine: str) -> None:
        self.ask(machine, self._request)
        with self._lock:
            self._busy[machine] -= 1
