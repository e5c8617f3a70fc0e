"""The availability and cost of a simulated pool."""

from dataclasses import dataclass, field

HOURS_A_MONTH = 730.0
DAY_S = 86_400.0


@dataclass
class Sums:
    """Sums over one day, counted from the start of the measurement, or over all of it."""

    seconds: float = 0.0
    wanted_s: float = 0.0
    up_s: float = 0.0
    under_s: float = 0.0
    ready_s: float = 0.0
    usd: float = 0.0

    def add(self, seconds: float, ready: int, wanted: int, usd_per_hour: float) -> None:
        """Account for a span without changes."""
        self.seconds += seconds
        self.ready_s += seconds * ready
        self.usd += seconds / 3600.0 * usd_per_hour
        if wanted:
            self.wanted_s += seconds
            self.under_s += seconds if ready < wanted else 0.0
            self.up_s += seconds if ready else 0.0


@dataclass(frozen=True)
class Outcome:
    """One policy in one market, measured over `seconds`."""

    seconds: float
    available: float  # fraction of the time with a wanted replica that at least one served
    under_target: float  # fraction of that time that fewer served than the pool file wants
    mean_ready: float
    usd_per_hour: float
    launches: int  # orders that a cloud accepted
    refusals: int  # orders that it refused
    preemptions: int  # machines that were preempted or failed
    outages: int  # how often the pool stopped answering, and how long the longest was
    longest_outage_s: float
    days: tuple[Sums, ...] = ()


@dataclass
class Meter:
    """Measures from `begin_s` on; `curve` is the number of serving replicas over time."""

    begin_s: float
    sums: Sums = field(default_factory=Sums)
    launches: int = 0
    refusals: int = 0
    preemptions: int = 0
    outages: int = 0
    longest_outage_s: float = 0.0
    curve: list[tuple[float, int]] = field(default_factory=list)
    days: list[Sums] = field(default_factory=list)
    _down_s: float = 0.0
    _pending: tuple[float, int, int, float] = (0.0, -1, 0, 0.0)  # unlike any state

    def pass_time(
        self, now_s: float, seconds: float, *, ready: int, wanted: int, usd_per_hour: float
    ) -> None:
        """Account for a span before `now_s` without changes.

        Consecutive spans with equal values are merged, so the sums are the same to the last bit,
        however often this is called.
        """
        seconds = min(seconds, now_s - self.begin_s)
        if seconds <= 0:
            return
        before_s, *same = self._pending
        if same != [ready, wanted, usd_per_hour]:
            self._add_pending()
            before_s = 0.0
            if not self.curve or self.curve[-1][1] != ready:
                self.curve.append((now_s - seconds, ready))
        self._pending = (before_s + seconds, ready, wanted, usd_per_hour)

    def _add_pending(self) -> None:
        seconds, ready, wanted, usd_per_hour = self._pending
        self._pending = (0.0, ready, wanted, usd_per_hour)
        at = self.sums.seconds
        end = at + seconds
        while at < end:
            index = int(at // DAY_S)
            part_s = min(end, (index + 1) * DAY_S) - at
            self.days += [Sums() for _ in range(len(self.days), index + 1)]
            self.days[index].add(part_s, ready, wanted, usd_per_hour)
            at += part_s
        self.sums.add(seconds, ready, wanted, usd_per_hour)
        if ready or not wanted:
            self._down_s = 0.0
        elif seconds:
            self.outages += self._down_s == 0.0
            self._down_s += seconds
            self.longest_outage_s = max(self.longest_outage_s, self._down_s)

    def counts(self, now_s: float) -> bool:
        """Whether events now are counted."""
        return now_s >= self.begin_s

    def outcome(self) -> Outcome:
        """Return the figures so far."""
        self._add_pending()
        sums = self.sums
        return Outcome(
            seconds=sums.seconds,
            available=sums.up_s / sums.wanted_s if sums.wanted_s else 1.0,
            under_target=sums.under_s / sums.wanted_s if sums.wanted_s else 0.0,
            mean_ready=sums.ready_s / sums.seconds,
            usd_per_hour=sums.usd / (sums.seconds / 3600.0),
            launches=self.launches,
            refusals=self.refusals,
            preemptions=self.preemptions,
            outages=self.outages,
            longest_outage_s=self.longest_outage_s,
            days=tuple(self.days),
        )
