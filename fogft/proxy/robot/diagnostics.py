"""A client proxy's `/diagnostics` and parameters in ROS.

Owns: diagnostic levels, messages and values, and when to publish them. Not here: publishing
(`fogft.ros.visible`), the policies that parameters set (`fogft.poolfile.policy_parameters`).
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from fogft.model.spec import ServiceSpec
from fogft.model.topic import PREFIX
from fogft.poolfile.policy_parameters import FieldCheck, Policies
from fogft.records.expiry import SOON
from fogft.ros.port import Level, Status
from fogft.ros.visible import VisibleNode

WINDOW_S = 30.0
CREDENTIALS_SOON_S = 3600.0
UNMANAGED_AFTER_S = 90.0  # a manager signs a lease for its replicas every minute
# Outcomes of requests to warn about, and their wording.
_TROUBLES = {
    "silent": "got no answer",
    "empty": "got an empty answer",
    "turned_away": "were rejected",
    "poison": "crashed the service and were not retried",
    "fallback": "were answered by the fallback",
}
_COUNTS = (
    *("received", "sent", "answered", "fallback", "empty", "silent", "turned_away", "poison"),
    *("late", "rejected", "fallback_failed", "undelivered", "pending"),
)


class Diagnosis:
    """Turns reports into diagnostic statuses; those of the pool and its services name the robot."""

    def __init__(self, pool: str, robot: str) -> None:
        self._pool = pool
        self._robot = robot
        self._before: deque[tuple[float, dict[str, Counter[str]]]] = deque()

    def of(self, report: Mapping[str, Any], now: float) -> list[Status]:
        """Return the statuses of a report."""
        services: Mapping[str, Mapping[str, Any]] = report["services"]
        links = report["links"]
        lately = self._lately(services, now)
        of_services = [self._service(n, s, links, lately[n]) for n, s in services.items()]
        of_replicas = [self._replica(link, len(services)) for link in links]
        of_topics = [self._topic(n, t, links) for n, t in report.get("topics", {}).items()]
        return [self._overall(report, of_services), *of_services, *of_topics, *of_replicas]

    def _lately(
        self, services: Mapping[str, Mapping[str, Any]], now: float
    ) -> dict[str, Counter[str]]:
        """Return how often each service had each trouble in the last `WINDOW_S`."""
        counts = {n: Counter({k: s.get(k, 0) for k in _TROUBLES}) for n, s in services.items()}
        self._before.append((now, counts))
        while len(self._before) > 1 and self._before[1][0] <= now - WINDOW_S:
            self._before.popleft()
        then = self._before[0][1]
        return {name: found - then.get(name, Counter()) for name, found in counts.items()}

    def _overall(self, report: Mapping[str, Any], services: list[Status]) -> Status:
        links = report["links"]
        up = sum(link["state"] == "up" for link in links)
        worst = max((status.level for status in services), default=Level.WARN)
        leases = [one for one in links if one.get("lease_age_s") is not None]
        age_s = min((float(one["lease_age_s"]) for one in leases), default=0.0)
        left_s = min((float(one["lease_left_s"]) for one in leases), default=None)
        if report["uplink_suspected"]:
            message = "all replicas fell silent together: the robot's uplink is suspected"
            worst = Level.ERROR
        elif not links:
            message, worst = "there are no replicas", Level.ERROR
        else:
            message = f"{up} of {len(links)} replicas are reachable"
            worst = max(worst, Level.OK if up == len(links) else Level.WARN)
        if left_s is not None and age_s >= UNMANAGED_AFTER_S:
            message += f"; no manager is running, and replicas shut down in {left_s / 3600:.1f} h"
            worst = max(worst, Level.WARN)
        credentials_s = report.get("credentials_left_s")
        if credentials_s is not None and credentials_s < CREDENTIALS_SOON_S:
            if credentials_s > 0:
                message += f"; the cloud's credentials expire in {credentials_s / 60:.0f} min"
            else:
                message += "; the cloud's credentials have expired: nothing is launched or ended"
            worst = max(worst, Level.WARN)
        certificate_s = report.get("certificate_left_s")
        if certificate_s is not None and certificate_s < SOON.total_seconds():
            message += f"; this robot's certificate expires in {certificate_s / 86_400:.1f} days"
            worst = max(worst, Level.WARN)
        values = {
            "replicas": len(links),
            "replicas reached": up,
            "services": len(services),
            "uplink suspected": report["uplink_suspected"],
            "replicas end without a manager in_s": left_s,
            "credentials end in_s": credentials_s,
            "certificate ends in_s": certificate_s,
        }
        return self._status(worst, "pool", message, values, self._robot)

    def _service(
        self,
        name: str,
        report: Mapping[str, Any],
        links: list[Mapping[str, Any]],
        lately: Mapping[str, int],
    ) -> Status:
        ready = sum(name in link["ready"] for link in links)
        troubles = [f"{n} {_TROUBLES[key]}" for key, n in lately.items()]
        if not ready:
            level, message = Level.ERROR, "no replica can answer"
        elif ready < (quorum := report.get("quorum", 1)):
            level, message = Level.ERROR, f"{ready} of {quorum} replicas that must agree can answer"
        elif report.get("trouble"):
            level, message = Level.ERROR, str(report["trouble"])
        elif troubles:
            level, message = Level.WARN, f"in the last {WINDOW_S:.0f} s {', '.join(troubles)}"
        else:
            level = Level.OK if ready == len(links) else Level.WARN
            message = f"{ready} of {len(links)} replicas can answer"
        values: dict[str, Any] = {"type": report.get("type"), "ready replicas": ready}
        values |= {key: report[key] for key in _COUNTS if key in report}
        values |= {key[:-1] + "ms": _ms(report.get(key)) for key in ("p50_s", "p99_s")}
        if (poisoned_at := report.get("poisoned_at")) is not None:
            values["last poison"] = time.strftime("%FT%TZ", time.gmtime(poisoned_at))
        values |= {f"won by {replica}": n for replica, n in report.get("won", {}).items()}
        values |= {f"refused: {reason}": n for reason, n in report.get("refused", {}).items()}
        return self._status(level, f"service {name}", message, values, self._robot)

    def _topic(
        self, name: str, report: Mapping[str, Any], links: list[Mapping[str, Any]]
    ) -> Status:
        passing = sum(PREFIX + name in link["ready"] for link in links)
        message = str(report.get("trouble") or f"{passing} of {len(links)} replicas forward it")
        level = Level.ERROR if "trouble" in report or not passing else Level.OK
        if level is Level.OK and passing < len(links):
            level = Level.WARN
        values = {key: value for key, value in report.items() if key != "trouble"}
        return self._status(level, f"topic {name}", message, values, self._robot)

    def _replica(self, link: Mapping[str, Any], services: int) -> Status:
        state, ready = link["state"], len(link["ready"])
        detail = link.get("detail") or ""
        if state == "suspect":
            level, message = Level.ERROR, detail or "not responding"
        elif state != "up" or ready < services:
            level, message = Level.WARN, detail or "not all services can answer"
        elif link.get("draining"):
            level, message = Level.WARN, "machine about to be preempted"
        elif link.get("disagrees"):
            level, message = Level.WARN, "answers differ from the other replicas'"
        elif detail:  # it hangs, or an uplink is down
            level, message = Level.WARN, detail
        else:
            level, message = Level.OK, "responding"
        values = {
            "link": state,
            "ready services": ready,
            "rtt_ms": _ms(link.get("rtt_s")),
            "silent_for_s": link.get("silent_for_s"),
            **{key: link.get(key) for key in ("in_flight", "won", "restarts", "reopened")},
            "draining": link.get("draining"),
            "at risk": link.get("at_risk"),
        }
        who = f"{link['slot']}.{link['generation']}"
        return self._status(level, f"replica {who}", message, values, who)

    def _status(
        self, level: Level, what: str, message: str, values: Mapping[str, Any], hardware: str
    ) -> Status:
        told = {key: _told(value) for key, value in values.items() if value is not None}
        return Status(level, f"fogft {self._pool}: {what}", message, hardware, told)


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds * 1000, 3)


def _told(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.6g}" if isinstance(value, float) else str(value)


log = logging.getLogger(__name__)

_DIAGNOSE_EVERY_S = 1.0


class SeenFromRos:
    """The diagnostics and parameters of a pool and its services in ROS.

    `make_visible` creates the visible node, given a validator of parameters. If it returns None,
    nothing is shown or set.
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
        self._was_set = False
        self._diagnosis = Diagnosis(pool, robot)
        self._diagnosed = float("-inf")
        self._visible = make_visible(self._set)

    def follow(self, specs: Iterable[ServiceSpec]) -> tuple[ServiceSpec, ...]:
        """Take the services of the pool file; return them with parameters applied."""
        with self._lock:
            self._policies.follow(specs)
            return self._take()

    def changed(self) -> tuple[ServiceSpec, ...] | None:
        """Return the services with parameters applied if one was set since; None if not."""
        if not self._was_set:
            return None
        with self._lock:
            self._was_set = False
            return self._take()

    def _take(self) -> tuple[ServiceSpec, ...]:
        if self._visible is not None:
            self._visible.show(self._policies.parameters())
        return self._policies.services()

    def _set(self, values: Mapping[str, Any]) -> str:
        """Validate and set parameters; return an error, or "" (on the visible node's thread)."""
        with self._lock:
            try:
                self._policies.set(values)
            except (ValueError, TypeError) as error:
                return str(error)
            self._was_set = True
        log.info("policy_set values=%s", dict(values))
        return ""

    def diagnose(self, report: Callable[[], Mapping[str, Any]], now: float) -> None:
        """Publish the statuses of a report, at most once a second."""
        if self._visible is not None and now >= self._diagnosed + _DIAGNOSE_EVERY_S:
            self._diagnosed = now
            self._visible.diagnose(self._diagnosis.of(report(), now))
