"""The history of a pool's replicas: events in, facts out. Pure.

The cloud's list shows what exists now; the history shows what happened. It is the only memory that
must survive a crash of the manager.

Not here: the file it is stored in (`fogft.pool.folder.history_file`), the pauses after failures
(`backoff`).
"""

from __future__ import annotations

import copy
from bisect import insort
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from operator import itemgetter
from typing import ClassVar, NamedTuple

from fogft.model.choices import MAX_REPLICAS
from fogft.model.plain import Moment
from fogft.model.reason import Cause, Reason
from fogft.model.replica import supply
from fogft.planning.observed.clock_jumps import moved

_AT = itemgetter(0)


class EventKind(str, Enum):
    """The kinds of events."""

    LAUNCH = "launch"  # written before the cloud is asked: the generation is used from here on
    REFUSED = "refused"  # the cloud said no: capacity, quota or an error
    READY = "ready"  # its services answer
    UNREADY = "unready"  # its services no longer answer
    DRAINING = "draining"  # marked to end
    UNDRAINED = "undrained"  # the mark was taken back
    FAILED = "failed"  # its launch has failed
    ENDING = "ending"  # recorded before the cloud is asked to end it
    ENDED = "ended"  # gone, as asked
    GONE = "gone"  # gone, unasked: preempted, crashed or ended by someone else
    CLOCK = "clock"  # of no replica: the wall clock was set
    SLEPT = "slept"  # of no replica: the manager's machine slept
    UPDATING = "updating"  # of no replica: a changed file is being applied
    UPDATE_STOPPED = "update_stopped"  # of no replica: an update was given up
    PROXY_REPLACED = "proxy_replaced"  # of no replica: another client proxy took over


MOVING = frozenset({EventKind.CLOCK, EventKind.SLEPT})
TOLD_ONLY = frozenset({EventKind.UPDATING, EventKind.UPDATE_STOPPED, EventKind.PROXY_REPLACED})
OF_NO_REPLICA = MOVING | TOLD_ONLY
CLOSING = frozenset({EventKind.REFUSED, EventKind.ENDED, EventKind.GONE})


@dataclass(frozen=True)
class Event:
    """One event in the history."""

    omits_defaults: ClassVar[bool] = True  # written as plain data

    at: Moment  # seconds since the epoch
    kind: EventKind
    slot: int
    generation: int
    location: str = ""  # where (`cloud/region/zone`); empty in events after the launch
    reason: Reason | None = None  # why it happened, where that is known
    on_demand: bool = False  # of a launch: not bought on the spot market
    by_s: float = 0.0  # of CLOCK and SLEPT: how far earlier times are shifted
    version: str = ""  # of a launch: what it runs (`replica_hash`)


_NO_FAULT = Reason(Cause.ERROR)
_TIMES = ("launched_at", "closed_at", "first_ready_at", "unready_since", "draining_since")
OWN_FAULTS = frozenset({Cause.SETUP, Cause.NOT_SET_UP, Cause.NOT_READY})
LAUNCHES_KEPT_S = 3600.0
# A loss counts as a failure of the location if the replica had been ready for less than this.
YOUNG_S = 60.0
KEPT_S = 86_400.0
_PROOFS = 2 * MAX_REPLICAS  # how many of a version's failed launches are kept


@dataclass
class Record:
    """Facts about one launch. Times in seconds since the epoch; None for never."""

    slot: int
    generation: int
    launched_at: float
    location: str = ""
    first_ready_at: float | None = None
    unready_since: float | None = None
    draining_since: float | None = None
    failed: bool = False
    ending: bool = False
    ends_for: Reason | None = None
    closed: EventKind | None = None
    closed_at: float = 0.0
    on_demand: bool = False
    version: str = ""
    fault: Reason = _NO_FAULT

    @property
    def supply(self) -> str:
        """The supply that it came from; see `Placement.supply`."""
        return supply(self.location, on_demand=self.on_demand)


class Failure(NamedTuple):
    """A failure of a location: it refused a launch, a launch failed, or a replica died early."""

    at: float
    cause: Cause


def fault_of(reason: Reason | None) -> Cause:
    """Return the cause of a failure; for a time-out, the phase that took too long."""
    if reason is None:
        return Cause.ERROR
    awaited = reason.because[0].cause if reason.because else reason.cause
    return awaited if reason.cause is Cause.TIMEOUT and awaited in OWN_FAULTS else reason.cause


class History:
    """Facts derived from events. Only `add` changes them; planner and placement only read."""

    def __init__(self, events: Iterable[Event] = ()) -> None:
        self._records: dict[tuple[int, int], Record] = {}
        self._open: dict[tuple[int, int], Record] = {}
        # Slot -> the highest generation ever used, and the highest ever ready; 0 for none.
        self.generations: Counter[int] = Counter()
        self.served: Counter[int] = Counter()
        self.failures: dict[str, list[Failure]] = {}  # by supply, oldest first
        self._proven_at: dict[str, float] = {}
        self.losses: dict[str, list[float]] = {}  # when, by location, oldest first
        self.lives: dict[str, tuple[Record, ...]] = {}  # of spot machines, by location
        # Cache of `hazard` by location: as of when, the rate; until lives or failures change.
        self.rates: dict[str, tuple[float, float]] = {}
        self._set: list[tuple[float, float]] = []  # clock changes: when (old time), by how much
        self.version = 0  # of all facts: the number of events
        self.fruitless: dict[str, list[Record]] = {}  # by version: launches failed by its own fault
        self.ready_versions: set[str] = set()
        # Whether on demand -> the launches within an hour before the latest one.
        self.launches: dict[bool, list[Record]] = {False: [], True: []}
        for event in events:
            self.add(event)

    def add(self, event: Event) -> None:
        """Take one more event into account. Events come in the order they happened."""
        self.version += 1
        if event.kind in OF_NO_REPLICA:
            if event.kind in MOVING:
                self._move(event)
            return
        key = (event.slot, event.generation)
        if event.generation > self.generations.get(event.slot, -1):
            self.generations[event.slot] = event.generation
        record = self._records.get(key)
        starts = event.kind is EventKind.LAUNCH
        if record is None or (starts and record.closed is EventKind.ENDED):  # a standby restarts
            record = Record(event.slot, event.generation, event.at, event.location)
            record.on_demand, record.version = event.on_demand, event.version
            self._records[key] = record
            if starts:
                kept = self.launches[record.on_demand]
                lately = [r for r in kept if r.launched_at > record.launched_at - LAUNCHES_KEPT_S]
                self.launches[record.on_demand] = [*lately, record]
            if not record.on_demand:
                self.lives[record.location] = (*self.lives.get(record.location, ()), record)
        if starts:  # a second launch: the machine was thought gone, but is listed
            record.closed, record.ending = None, False
        else:
            self._update(record, event)
        if record.closed is None:
            self._open[key] = record
        else:
            self._open.pop(key, None)

    def _move(self, event: Event) -> None:
        """Shift all recorded times, so that durations stay the same."""
        if event.kind is EventKind.CLOCK:
            self._set.append((event.at - event.by_s, event.by_s))
        later = partial(moved, by_s=event.by_s, now=event.at)
        for record in self._records.values():
            for name in _TIMES:
                if (at := getattr(record, name)) is not None:
                    setattr(record, name, later(at))
        self.failures = {
            supply: sorted((Failure(later(f.at), f.cause) for f in failures), key=_AT)
            for supply, failures in self.failures.items()
        }
        self.losses = {p: sorted(map(later, losses)) for p, losses in self.losses.items()}
        self._proven_at = {supply: later(at) for supply, at in self._proven_at.items()}
        self.rates = {}

    def by_clock(self, instant: float) -> float:
        """Convert a recorded time to the current clock, which may have been set since."""
        for old, by_s in self._set:
            instant += by_s if instant <= old else 0.0
        return instant

    def followed_by(self, events: Iterable[Event]) -> History:
        """Return a copy of this history with launches and marks added."""
        later = copy.copy(self)
        # Launches and marks change nothing else.
        later._records, later._open = dict(self._records), dict(self._open)
        later.generations, later.launches = self.generations.copy(), dict(self.launches)
        later.lives, later.rates = dict(self.lives), dict(self.rates)
        for event in events:
            key = (event.slot, event.generation)
            if key in later._records:
                later._records[key] = replace(later._records[key])
            later.add(event)
        return later

    def _update(self, record: Record, event: Event) -> None:
        kind = event.kind
        if kind in CLOSING:
            self._close(record, event)
        elif kind is EventKind.READY:
            if record.first_ready_at is None:
                record.first_ready_at = event.at
            record.unready_since = None
            if record.version:
                self.ready_versions.add(record.version)
            self.served[record.slot] = max(self.served[record.slot], record.generation)
            self._proven_at[record.supply] = event.at
        elif kind is EventKind.UNREADY:
            record.unready_since = event.at
        elif kind is EventKind.DRAINING:
            record.draining_since = event.at
        elif kind is EventKind.UNDRAINED:
            record.draining_since = None
        elif kind is EventKind.ENDING:
            record.ending, record.ends_for = True, event.reason
        elif kind is EventKind.FAILED:
            record.failed = True
            record.fault = event.reason or _NO_FAULT
            if fault_of(event.reason) in OWN_FAULTS:
                self.fruitless.setdefault(record.version, []).append(record)
            self._fail(record, event)

    def _close(self, record: Record, event: Event) -> None:
        kind = event.kind
        self.rates.pop(record.location, None)
        if kind is EventKind.REFUSED:
            self._fail(record, event)
            if record.location in self.lives:
                kept = self.lives[record.location]
                self.lives[record.location] = tuple([r for r in kept if r is not record])
        elif kind is EventKind.GONE:
            ready_at = record.first_ready_at
            if ready_at is None or event.at - ready_at < YOUNG_S:
                self._fail(record, event)
            insort(self.losses.setdefault(record.location, []), event.at)
        record.closed = kind
        record.closed_at = event.at

    def _fail(self, record: Record, event: Event) -> None:
        failure = Failure(event.at, fault_of(event.reason))
        self.rates.pop(record.location, None)
        insort(self.failures.setdefault(record.supply, []), failure, key=_AT)

    def record(self, slot: int, generation: int) -> Record | None:
        """Return the record of a launch."""
        return self._records.get((slot, generation))

    def open(self) -> list[Record]:
        """Return the launches that are not known to have ended."""
        return list(self._open.values())

    def places_alone(self) -> History:
        """Return a history with only the facts about locations, as for a new pool."""
        anew = History()
        anew.failures, anew._proven_at = self.failures, self._proven_at
        anew.lives, anew.losses = self.lives, self.losses
        return anew

    @property
    def locations(self) -> frozenset[str]:
        """Every location with a launch."""
        return frozenset(record.location for record in self._records.values())

    def proofs(self) -> set[tuple[int, int]]:
        """Return the launches that prove whether a version ever served: slot and generation."""
        failed = [record for records in self.fruitless.values() for record in records[-_PROOFS:]]
        ready = {r.version: r for r in self._records.values() if r.version in self.ready_versions
                 and r.first_ready_at is not None}  # fmt: skip
        return {(record.slot, record.generation) for record in (*failed, *ready.values())}

    def proven_at(self, supply: str) -> float:
        """Return when a replica of this supply last became ready; minus infinity for never."""
        return self._proven_at.get(supply, float("-inf"))


def compacted(
    events: Iterable[Event], now: float, *, history: History | None = None
) -> list[Event]:
    """Drop events that no decision needs any more.

    Launches are kept if they are open, had an event within `KEPT_S`, are the latest of their slot,
    or prove that a version was given up. Of a launch's READY and UNREADY events, the first READY
    and the last two are kept. Changes of the clock are always kept.
    """
    events = list(events)
    history = history or History(events)
    kept = {(r.slot, r.generation) for r in history.open()}
    later_s = 0.0
    told = set()
    for index, event in reversed(list(enumerate(events))):
        if event.kind in MOVING:
            later_s += event.by_s
        elif now - (event.at + later_s) < KEPT_S:
            if event.kind in TOLD_ONLY:
                told.add(index)
            else:
                kept.add((event.slot, event.generation))
    flapping: dict[tuple[int, int], list[int]] = {}
    for index, event in enumerate(events):
        if event.kind in (EventKind.READY, EventKind.UNREADY):
            flapping.setdefault((event.slot, event.generation), []).append(index)
    kept |= history.proofs()
    dropped: set[int] = set()
    for indices in flapping.values():
        first_ready = [i for i in indices if events[i].kind is EventKind.READY][:1]
        dropped |= set(indices) - {*first_ready, *indices[-2:]}
    out: list[Event] = []
    for index, e in enumerate(events):
        is_last = e.generation == history.generations[e.slot]
        if (
            e.kind is EventKind.CLOCK
            or (e.kind is EventKind.SLEPT and out)
            or index in told
            or (
                e.kind not in OF_NO_REPLICA
                and index not in dropped
                and (e.slot, e.generation) in kept
            )
            or (is_last and (e.kind is EventKind.LAUNCH or e.kind in CLOSING))
        ):
            out.append(e)
    return out
