"""Crash reports of replicas that are broken, or lie, and those that count. Pure."""

from collections.abc import Iterable

FALSE_ALARMS, LATELY_S = 3, 60.0  # so many false alarms lately, and it is not believed
ALARM_S = 1.0  # what is said within it, counted from the first time, is about one death


class Alarms:
    """Which replicas are believed when they report that a request crashed a service.

    What one says in the same moment is one alarm, and false where another replica answered one of
    those requests. Were it believed, the others would run each of them alone.
    """

    def __init__(self) -> None:
        self._said_at: dict[int, float] = {}
        self._judged: set[int] = set()  # whose last alarm counts as a false one already
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
