"""What people see of a client proxy in ROS, and what they change there.

Owns: bringing together the visible node, the diagnosis and the policies that parameters set.
Not here: how each of them works (`fogft.ros.visible`, `diagnostics`, `poolfile.policy_parameters`).
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

from fogft.model.spec import ServiceSpec
from fogft.poolfile.policy_parameters import FieldCheck, Policies
from fogft.proxy.robot.diagnostics import Diagnosis

if TYPE_CHECKING:
    from fogft.ros.visible import VisibleNode

log = logging.getLogger(__name__)

_DIAGNOSE_EVERY_S = 1.0


class SeenFromRos:
    """The proxied services and the pool, as ROS's tools see them.

    Args:
        make_visible: Makes the visible node, given who judges parameters; returns None where
            there is none, and then nothing is shown or set.
        check_field: Says why a type's response has no boolean field of that name.
    """

    def __init__(
        self,
        pool: str,
        robot: str,
        make_visible: Callable[[Callable[[Mapping[str, Any]], str]], VisibleNode | None],
        check_field: FieldCheck,
    ) -> None:
        self._policies = Policies(check_field)
        self._lock = threading.Lock()
        self._was_set = threading.Event()
        self._diagnosis = Diagnosis(pool, robot)
        self._diagnosed = float("-inf")
        self._visible = make_visible(self._set)

    def follow(self, specs: Iterable[ServiceSpec]) -> tuple[ServiceSpec, ...]:
        """Take the pool file's services; return them as they are to be proxied."""
        with self._lock:
            self._policies.follow(specs)
            return self._take()

    def changed(self) -> tuple[ServiceSpec, ...] | None:
        """Return the services as they are to be proxied if a parameter was set since; else None."""
        if not self._was_set.is_set():
            return None
        with self._lock:
            self._was_set.clear()
            return self._take()

    def _take(self) -> tuple[ServiceSpec, ...]:
        if self._visible is not None:
            self._visible.show(self._policies.parameters())
        return self._policies.services()

    def _set(self, values: Mapping[str, Any]) -> str:
        """Judge what somebody sets (the visible node's thread)."""
        with self._lock:
            try:
                self._policies.set(values)
            except ValueError as error:
                return str(error)
        log.info("policy_set values=%s", dict(values))
        self._was_set.set()
        return ""

    def diagnose(self, report: Callable[[], Mapping[str, Any]], now: float) -> None:
        """Publish the statuses of a report, once a second."""
        if self._visible is not None and now >= self._diagnosed + _DIAGNOSE_EVERY_S:
            self._diagnosed = now
            self._visible.diagnose(self._diagnosis.of(report(), now))
