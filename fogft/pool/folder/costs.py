"""The cost of a pool's machines so far, by replica and day (UTC), as seen by its manager.

Each call of `look` charges the time since the last one: at the current price of a spot machine if
known, else at the price of the order. A machine that disappeared while no manager ran is charged
for as long as it can have run without one. A refused launch costs nothing.

The file is kept when the pool has ended.
"""

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from fogft import disk
from fogft.errors import StateError
from fogft.model.plain import to_plain
from fogft.model.reason import Cause
from fogft.model.replica import Observed, Placement
from fogft.planning.observed.clock_jumps import moved

log = logging.getLogger(__name__)

LOOK_EVERY_S = 10.0
WRITE_EVERY_S = 60.0
DAY_S = 86_400.0
_COST_NOTHING = frozenset({Cause.CAPACITY, Cause.QUOTA, Cause.CREDENTIALS})
_DAYS_KEPT = 400


@dataclass(frozen=True)
class Spent:
    """The cost of one replica on one day."""

    day: str  # as in ``2026-11-23``, of UTC
    replica: str  # ``slot.generation``
    location: str
    instance: str
    spot: bool
    hours: float
    usd: float  # with its disk, its address and the responses that leave the cloud


@dataclass(frozen=True)
class Running:
    """A running machine: until when it has been charged, and its price."""

    until: float
    usd_per_hour: float
    placement: Placement


@dataclass(frozen=True)
class Costs:
    """The cost of one pool. Days no longer kept are summed up in `before_usd`."""

    pool: str
    uid: str
    spent: tuple[Spent, ...] = ()
    running: Mapping[str, Running] = field(default_factory=dict)
    before_usd: float = 0.0

    @property
    def usd(self) -> float:
        """The total, in US dollars."""
        return self.before_usd + sum(one.usd for one in self.spent)


class CostBook:
    """Keeps the costs of one pool: one process writes them."""

    def __init__(self, folder: Path, pool: str, uid: str) -> None:
        self._path = path_of(folder, pool, uid)
        self._written_at: float | None = None
        self._looked_at = self._set_s = 0.0
        found = _read(self._path)
        self._kept = found if found is not None and found.uid == uid else Costs(pool, uid)
        self._days = {(one.day, one.replica): one for one in self._kept.spent}
        self._running = self._kept.running

    def look(self, observed: Observed, alone_s: float, set_s: float = 0.0) -> None:
        """Charge running machines up to now, and save from time to time.

        Args:
            alone_s: How long a machine can run without a manager.
            set_s: How far the clock was set since this book was opened: that time costs nothing.

        Raises:
            StateError: The file cannot be written; the costs are kept, and written later.
        """
        now = observed.now
        machines = (*(observed.machines or ()), *observed.gateway, *observed.standbys)
        if by_s := set_s - self._set_s:
            self._running = {
                name: replace(one, until=moved(one.until, by_s, now))
                for name, one in self._running.items()
            }
            self._set_s = set_s
        same = self._running.keys() == {machine.id.short for machine in machines}
        if same and 0 <= now - self._looked_at < LOOK_EVERY_S:
            return
        self._looked_at = now
        spots = {m.placement for m in machines if m.placement.spot}
        prices = {
            o.placement: o.usd_per_hour
            for o in observed.offers
            if o.placement in spots and o.usd_per_hour >= 0.0
        }
        seen: dict[str, Running] = {}
        gone = dict(self._running)
        for machine in machines:
            name, place = machine.id.short, machine.placement
            last = gone.pop(name, None)
            if machine.failure is not None and machine.failure.cause in _COST_NOTHING:
                charged_h = sum(one.hours for key, one in self._days.items() if key[1] == name)
                if charged_h * 3600 <= now - machine.launched_at + LOOK_EVERY_S:  # else it has run
                    self._days = {key: one for key, one in self._days.items() if key[1] != name}
                continue
            price = prices.get(place, machine.usd_per_hour)
            begun = machine.launched_at or now
            if last is not None:  # a manager whose clock was slow may have told a time before it
                begun = last.until if begun > now else max(begun, last.until)
            self._charge(name, place, begun, now, price)
            seen[name] = Running(now, price, place)
        for name, last in gone.items():
            until = min(now, last.until + alone_s)
            self._charge(name, last.placement, last.until, until, last.usd_per_hour)
        ended = self._running.keys() - seen.keys()
        self._running = seen
        due = self._written_at is None or not 0 <= now - self._written_at < WRITE_EVERY_S
        if due or ended:
            self._settle(now)
            disk.make_folder(self._path.parent)
            disk.write_json(self._path, to_plain(self._kept), durable=False)
            self._written_at = now

    @property
    def usd(self) -> float:
        """The total cost, in US dollars."""
        return self._kept.before_usd + sum(one.usd for one in self._days.values())

    def _charge(self, name: str, place: Placement, begun: float, end: float, price: float) -> None:
        while begun < end:
            day_ends = (begun // DAY_S + 1) * DAY_S
            until, day = min(end, day_ends), _day(begun)
            hours = (until - begun) / 3600
            before = self._days.get((day, name)) or Spent(
                day, name, place.location, place.instance, place.spot, 0.0, 0.0
            )
            self._days[day, name] = replace(
                before, hours=before.hours + hours, usd=before.usd + hours * price
            )
            begun = until

    def _settle(self, now: float) -> None:
        oldest = _day(now - _DAYS_KEPT * DAY_S)
        old = [key for key in self._days if key[0] < oldest]
        before_usd = self._kept.before_usd + sum(self._days.pop(key).usd for key in old)
        spent = tuple(self._days[key] for key in sorted(self._days))
        self._kept = replace(self._kept, spent=spent, running=self._running, before_usd=before_usd)


def read_all(folder: Path) -> list[Costs]:
    """Return the costs of all pools of this user, including ended ones, by name."""
    found = (_read(path) for path in sorted(folder.glob("*.json")))
    return [one for one in found if one is not None]


def path_of(folder: Path, pool: str, uid: str) -> Path:
    """Return where the costs of a pool are kept."""
    return folder / f"{pool}-{uid}.json"


def _read(path: Path) -> Costs | None:
    try:
        return disk.read_as(Costs, path)
    except StateError as error:
        log.warning("costs_damaged file=%s reason=%r", path, str(error))
        return None


def _day(at: float) -> str:
    return time.strftime("%Y-%m-%d", time.gmtime(at))
