"""Which crash reports to believe: a replica may be broken, or lie. Pure."""

from collections.abc import Iterable

FALSE_ALARMS, LATELY_S = 3, 60.0  # a replica with this many recent false alarms is not believed
ALARM_S = 1.0  # reports within this time of the first are about the same crash


class Alarms:
    """Which replicas are believed when they report that a request crashed a service.

    A replica's reports within `ALARM_S` are one alarm, false if another replica answers one of
    those requests. If false alarms counted, the other replicas would run each request alone.
    """

    def __init__(self) -> None:
        self._said_at: dict[int, float] = {}
        self._judged: set[int] = set()  # replicas whose last alarm was already counted as false
        self._false: dict[int, list[float]] = {}

    def believed(self, replica: int, now: float) -> bool:
        """Take a crash report; return whether it counts."""
        if now - self._said_at.get(replica, -ALARM_S) >= ALARM_S:
            self._said_at[replica] = now
            self._judged.discard(replica)
        lately = [at for at in self._false.get(replica, ()) if now - at < LATELY_S]
        self._false[replica] = lately
        return len(lately) < FALSE_ALARMS

    def was_false(self, replica: int, now: float) -> None:
        """Note a false report: another replica has answered the request."""
        if replica not in self._judged:
            self._judged.add(replica)
            self._false.setdefault(replica, []).append(now)

    def were_right(self, replicas: Iterable[int]) -> None:
        """Note correct reports: the request does crash services."""
        for replica in replicas:
            self._false.pop(replica, None)
