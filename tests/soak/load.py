"""Requests that go on the whole time, and how long each took, by the fault that there was."""

from __future__ import annotations

import random
import threading
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

from tests.link.wire_pool import SERVICE
from tests.proxy.gateway_pool import Robot

EVERY_S = 0.05
SIZES = (8, 1000, 10_000, 100_000)
CALM = "none"


class Load:
    """One robot's callers. `robot` is used by this and, under `lock`, by others.

    Attributes:
        during: The fault that there is now.
        took: Fault -> how long each request took that was asked during it, in seconds.
    """

    def __init__(self, name: str, robot: Robot, seed: int) -> None:
        self.name = name
        self.during = CALM
        self.took: Mapping[str, list[float]] = defaultdict(list)
        self.told: dict[str, Any] = {}
        self._robot = robot
        self._chance = random.Random(f"{seed} {name}")
        self._asked_during: dict[int, str] = {}
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"load-{name}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.wait(EVERY_S):
                self._ask(self._chance.choice(SIZES))
        except BaseException as error:
            self._error = error

    def _ask(self, size: int) -> None:
        during = self.during
        self._note(self._robot.tell(ask=1, bytes=size), during)

    def _note(self, told: dict[str, Any], during: str = "") -> None:
        if during:
            self._asked_during[told["next"] - 1] = during
        for number, took_s in told["took"]:
            self.took[self._asked_during.pop(number, during or CALM)].append(took_s)
        self.told = {**told, "took": []}

    def ended(self) -> bool:
        """Whether all was answered; takes the answers that came."""
        self._stop.set()
        self._thread.join()
        if self._error is not None:
            raise self._error
        self._note(self._robot.tell())
        return self.told["right"] + len(self.told["wrong"]) >= self.told["asked"]

    def count(self, name: str) -> int:
        """Return one of the proxy's own counts."""
        return int(self.told["report"]["services"][SERVICE].get(name, 0))
