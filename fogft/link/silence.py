"""How long a replica has been silent, by what was asked of it. Pure: `now` is an argument.

Silence begins with the first probe that goes unanswered (or with a lost connection), not
with the last answer: nobody is silent who was not asked. Time during which this process was
itself suspended is not held against the replica.

Source of the idea: an unanswered probe tells of health; a lease or liveliness token does not.
"""

from __future__ import annotations


class Silence:
    """The silence of one replica. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._since: float | None = None

    def began(self, now: float) -> None:
        """A probe was sent, or none can be sent. Silence that goes on is not begun anew."""
        if self._since is None:
            self._since = now

    def ended(self) -> None:
        """An answer came."""
        self._since = None

    def excuse(self, held_up_s: float, now: float) -> None:
        """Leave out `held_up_s` up to `now`, in which this process did not run."""
        if self._since is not None and held_up_s > 0:
            self._since = min(self._since + held_up_s, now)

    def for_s(self, now: float) -> float:
        """Return for how long it has lasted; 0 while probes are answered."""
        return 0.0 if self._since is None else max(0.0, now - self._since)
