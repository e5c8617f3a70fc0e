"""When a service is offered on the robot. Pure: time comes in.

`wait_for_service` in the robot's code is true exactly while it is. A service that is withdrawn
loses what is sent to it meanwhile, so it is not withdrawn for a moment's silence, nor under a
request that may still be answered.

Owns: the rule. Not here: offering it (`fogft.proxy.robot.proxied_service`).
"""

from __future__ import annotations

from fogft.model.spec import Advertise, ServiceSpec

# Longer than the command of a lone replica takes to be started again.
HOLD_S = 3.0


class Advertising:
    """Whether one service is to be offered, as its replicas come and go."""

    def __init__(self) -> None:
        self._offered = False
        self._unable_since: float | None = None

    def wanted(self, spec: ServiceSpec, *, able: bool, waiting: int, now: float) -> bool:
        """Return whether it is to be offered now.

        Args:
            spec: Its policy and its `timeout_s`.
            able: Whether some replica can answer.
            waiting: How many requests have no answer yet.
            now: Monotonic seconds.
        """
        at_once = spec.fallback is not None and spec.fallback.while_none_ready
        if able or at_once or spec.advertised is Advertise.ALWAYS:
            self._offered, self._unable_since = True, None
        elif self._offered and spec.advertised is Advertise.WHILE_READY:
            if self._unable_since is None:
                self._unable_since = now
            limit_s = HOLD_S + (spec.timeout_s if waiting else 0.0)
            self._offered = now < self._unable_since + limit_s
        return self._offered
