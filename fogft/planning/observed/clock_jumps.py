"""Detect that the wall clock was set, or that the machine slept. Pure: readings come in.

Recorded times are wall-clock times, since those remain valid after a reboot. Time that the wall
clock gains on a monotonic clock that stops during sleep is time in which nothing was observed:
recorded times are shifted by it, so that durations stay the same.

Not here: reading clocks (`fogft.pool.manager.timekeeping`), shifting recorded times (`history`).
"""

from dataclasses import dataclass

from fogft.model.reason import Cause, Reason

# Smaller jumps are ignored: slewing between two readings, or a slow reading.
LEAST_S = 5.0
# A clock that was set is often set again soon. Until it has not been set for this long, nothing is
# launched or ended because of the time of day.
DOUBT_S = 60.0


@dataclass(frozen=True)
class Reading:
    """Three clocks at one moment, in seconds."""

    wall_s: float  # since the epoch; may be set
    awake_s: float  # monotonic; stops while the machine sleeps
    steady_s: float  # monotonic; goes on while the machine sleeps


@dataclass(frozen=True)
class Jump:
    """How far the wall clock jumped between two readings."""

    set_s: float = 0.0  # how far it was set: forward above 0, back below
    slept_s: float = 0.0  # how long the machine slept

    @property
    def reason(self) -> Reason:
        """The jump as a reason: the clock was set, or the machine slept."""
        slept = Reason(Cause.SLEPT, seconds=self.slept_s)
        if not self.set_s:
            return slept
        return Reason(Cause.CLOCK_SET, seconds=self.set_s, because=(slept,) if self.slept_s else ())


def moved(at: float, by_s: float, now: float) -> float:
    """Return a remembered time after the clock gained `by_s`; it is `now`.

    A time later than the clock was before is kept: a better clock wrote it before a reboot.
    """
    return at + by_s if at <= now - by_s else at


class Watch:
    """Compares the readings of one process. Call `look` at every tick."""

    def __init__(self) -> None:
        self._last: Reading | None = None
        self._set: list[tuple[float, float]] = []  # when, and by how much
        self.set_s = 0.0  # the total

    def look(self, reading: Reading) -> Jump | None:
        """Return the jump since the last look, if there was one."""
        last, self._last = self._last, reading
        if last is None:
            return None
        awake_s = reading.awake_s - last.awake_s
        slept_s = max(reading.steady_s - last.steady_s - awake_s, 0.0)
        set_s = reading.wall_s - last.wall_s - awake_s - slept_s
        jump = Jump(set_s if abs(set_s) >= LEAST_S else 0.0, slept_s if slept_s >= LEAST_S else 0.0)
        if jump.set_s:
            self._set.append((reading.awake_s, jump.set_s))
            self.set_s += jump.set_s
        return jump if jump.set_s or jump.slept_s else None

    @property
    def doubt_s(self) -> float:
        """How far the clock was set within the last minute; schedules ignore so recent a change."""
        now = self._last.awake_s if self._last is not None else 0.0
        return sum((set_s for at, set_s in self._set if now - at < DOUBT_S), 0.0)
