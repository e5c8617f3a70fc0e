"""One service's unanswered requests, with its hedging and decision policies. Pure.

Each step of a request's life keeps the table, the policy and the decision in sync, and returns what
to do next. Called under its owner's lock. The first success removes the request from the table,
so any later answer is LATE by construction. A replica that declined or failed a request, or joined
after it, may be asked even while others work on it: they may be frozen.

Owns: which replicas may be asked (`_next_for`). Not here: which are (`choose`), what an answer
means (`decide`), when to call the fallback (`fallback`), sending (`proxy.robot.dispatcher`).
"""

from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from typing import Any

from fogft.model.refusal import Effect, Refusal
from fogft.requests.alarms import Alarms
from fogft.requests.choose import Choose
from fogft.requests.decide import Decide, Judgement, Means, Pending
from fogft.requests.fallback import FallbackTimer
from fogft.requests.load import NEVER, Load


class Verdict(Enum):
    """The verdict on the end of an attempt."""

    WON = "won"  # return this answer; the request is closed
    WAIT = "wait"  # another attempt is still open
    IDLE = "idle"  # no attempt is open any more: try again, or return the rejection
    LATE = "late"  # already answered, expired or never known: drop it
    POISON = "poison"  # it crashed services: never send it again


ATTEMPTS = 3  # a replica that failed a request this often is barred from it
RETRY_FIRST_S = 0.02
RETRY_LIMIT_S = 0.32
POISON_DEATHS = 2  # once beside other requests, then alone: no coincidence
# For this long after a death no request is at all replicas at once: it could crash all of them.
CAUTIOUS_S = 60.0
_SPREADS_AFTER_S = 1.0
LOOK_AGAIN_S = 0.02  # at a request for which the policy names no time
_NO_WAIT = (0.0, RETRY_FIRST_S / 2)


class PendingRequests:
    """The unanswered requests of one service.

    With `counts_deaths`, a request may be blamed for the death of a service running it.
    """

    def __init__(self, choose: Choose, decide: Decide, *, counts_deaths: bool = False) -> None:
        self.held_bytes = 0  # of all payloads together
        self.choose = choose
        self.decide = decide
        self.fallback: FallbackTimer | None = None
        self.soonest_deadline = NEVER  # a lower bound of all deadlines
        self._pending: dict[bytes, Pending] = {}
        self.size = self._pending.__len__
        # Requests that may need another attempt, and when to look at each next.
        self._short: dict[bytes, float] = {}
        self._rejected: dict[bytes, None] = {}  # requests that have a rejected answer
        self._counts_deaths = counts_deaths
        self._able: Sequence[int] = ()  # the able replicas at the last `begin` or `more`
        self._cautious_until = -NEVER
        self._alarms = Alarms()

    def __len__(self) -> int:
        return len(self._pending)

    def __contains__(self, request: bytes) -> bool:
        return request in self._pending

    def get(self, request: bytes | None) -> Pending | None:
        """Return an unanswered request."""
        return None if request is None else self._pending.get(request)

    def use(self, choose: Choose) -> None:
        """Switch to another hedging policy, which reconsiders each request."""
        self.choose = choose
        self._short = dict.fromkeys(self._pending, 0.0)

    # -- a request begins, and is sent to replicas ----------------------------------------

    def begin(
        self,
        request: bytes,
        payload: bytes,
        able: Sequence[int],
        *,
        deadline: float,
        now: float,
        handle: Any = None,
    ) -> Sequence[int]:
        """Add a request; return the replicas it goes to now. Raises ValueError for a known id."""
        if request in self._pending:
            raise ValueError("a request with this id is under way already")
        if not self._pending:
            self.choose.look_at = NEVER  # it was for requests that have ended
        self._able, chosen = able, self.choose.first(request, able, now)
        if now < self._cautious_until and len(chosen) > (most := self._most_at_once(able)):
            for spared in chosen[most:]:
                self.choose.declined(request, spared, full=False)
            chosen = chosen[:most]
        started = dict.fromkeys(chosen, now)
        pending = self._pending[request] = Pending(deadline, payload, handle, now, started)
        self.soonest_deadline = min(self.soonest_deadline, deadline)
        if not chosen or len(chosen) < len(able):
            self._short[request] = 0.0
        self.held_bytes += len(payload)
        if not self.decide.takes_any:
            self.decide.began(request, pending, able)
        return chosen

    def more(
        self, able: Sequence[int], now: float, *, newest_first: bool
    ) -> list[tuple[bytes, int]]:
        """Return the requests to send to additional replicas now, with those replicas."""
        self._able, choose, steps = able, self.choose, []
        if choose.news:
            choose.news = False
            self.use(choose)
        due, soonest = [], NEVER
        for request, at in self._short.items():  # many under overload, a hundred times a second
            if at <= now:
                due.append(request)
            elif at < soonest:
                soonest = at
        for request in due[::-1] if newest_first else due:
            choose.look_at = NEVER
            chosen, again_at = self._next_for(request, able, now)
            steps += [(request, replica) for replica in chosen]
            if again_at > now:
                self._short[request] = again_at  # or sooner, if something happens to it
                soonest = min(soonest, again_at)
            else:
                soonest = min(soonest, now + LOOK_AGAIN_S)
        choose.look_at = now if choose.news else soonest
        return steps

    def _next_for(
        self, request: bytes, able: Sequence[int], now: float
    ) -> tuple[Sequence[int], float]:
        """Return the replicas to ask now, and when to look again if nothing happens."""
        pending = self._pending[request]
        rests_until = {
            replica: pending.waits.get(replica, _NO_WAIT)[0]
            for replica in able
            if replica not in pending.open and replica not in pending.barred
        }
        for replica in pending.waits:  # it has refused, and would refuse again
            if rests_until.get(replica, NEVER) <= now and self.choose.too_busy(
                replica, pending.deadline - now, now
            ):
                rests_until[replica] = now + RETRY_LIMIT_S
        candidates = [replica for replica, at in rests_until.items() if at <= now]
        room = len(able)
        if pending.deaths:  # at one replica at a time
            if pending.open and now < pending.alone_until:
                return (), pending.alone_until
            room = 1
        elif now < self._cautious_until and pending.open:
            last = max(pending.open.values())
            waited = now >= min(last + _SPREADS_AFTER_S, (last + pending.deadline) / 2)
            room = (room if waited else self._most_at_once(able)) - len(pending.open)
            candidates = candidates[: max(0, room)]
        elif not candidates:
            return (), min(rests_until.values(), default=NEVER)
        if room <= 0:
            return (), now
        chosen = self.choose.more(request, pending.open, candidates, now)[:room]
        return chosen, self.choose.look_at if self.choose.look_at < NEVER else now

    @staticmethod
    def _most_at_once(able: Sequence[int]) -> int:
        """Return how many may get a request that may crash them: leave one to retry, one alive."""
        return max(1, len(able) - POISON_DEATHS)

    def attempt(self, request: bytes, replica: int, now: float) -> Pending | None:
        """Add another attempt; return None if it is no longer needed."""
        pending = self._pending.get(request)
        if pending is None or replica in pending.open or replica in pending.barred:
            self.choose.declined(request, replica, full=False)
            return None
        pending.open[replica] = now
        if pending.deaths:
            pending.alone_at.add(replica)
            pending.alone_until = (now + pending.deadline) / 2
        return pending

    def declined(self, request: bytes, replica: int) -> None:
        """Note that a link did not accept an attempt."""
        pending = self._pending.get(request)
        if pending is not None and replica in pending.open:
            self._ended(request, pending, replica)
        self.choose.declined(request, replica, full=True)

    def came(self, replicas: Iterable[int]) -> None:
        """Note that these replicas can be asked (again)."""
        for replica in replicas:
            for request, pending in self._pending.items():
                pending.waits.pop(replica, None)
                if replica not in pending.open and replica not in pending.barred:
                    self._short[request] = 0.0
            self.choose.forget(replica)

    def left(self, replicas: Iterable[int]) -> None:
        """Note that these replicas cannot be asked at present."""
        for replica in replicas:
            self.choose.forget(replica)

    def welcome(self, replica: int, about: Callable[[bytes], bool]) -> None:
        """Forget a replica's failures at requests matching `about`: it can be asked again."""
        for request, pending in self._pending.items():
            if about(pending.payload):
                pending.barred.discard(replica)
                pending.failures.pop(replica, None)
                pending.waits.pop(replica, None)
                if replica not in pending.open:
                    self._short[request] = 0.0

    # -- how its attempts end -------------------------------------------------------------

    def answered(  # noqa: PLR0917 - for each answer: a value to hold them costs more than they do
        self,
        id: bytes,
        request: bytes | None,
        replica: int,
        payload: bytes,
        reading: Any,
        load: Load | None,
        now: float,
    ) -> tuple[Judgement, Pending | None, Iterable[int], Verdict]:
        """Take an answer to `request`, or to no request if None.

        Returns its meaning; the item it completes, or None if it is late or no success; the other
        replicas, which should stop working on it; and the verdict.
        """
        pending = None if request is None else self._pending.get(request)
        means: Judgement = Means.SUCCESS
        if not self.decide.takes_any:
            means = self.decide.judge(id, replica, payload, reading, pending)
        if request is None:
            return means, None, (), Verdict.LATE
        if pending and pending.deaths and (died := pending.died_at - {replica}):
            # If only one died, it is rather the cause: another has survived the request.
            pending.deaths = min(pending.deaths, len(died) - 1)
            for other in died:
                self._alarms.was_false(other, now)
        if means is Means.SUCCESS and pending is not None and now < pending.deadline:
            open = pending.open
            self.choose.answered(request, open, replica, load, now)
            losers = [other for other in open if other != replica] if len(open) > 1 else ()
            self._take_out(request, pending)
            return means, pending, losers, Verdict.WON
        if load is not None:
            self.choose.heard(request, replica, load, now)
        if means is Means.SUCCESS:
            self.choose.late(request, replica, now, answered=True)
            return means, None, (), Verdict.LATE
        verdict = Verdict.LATE
        if means is Means.UNDECIDED:
            self._failed(request, pending, replica, now, counts=False, bar=True)
            verdict = Verdict.LATE if pending is None else Verdict.WAIT
        elif means is Means.REJECTION or means is Means.WEAKER_REJECTION:
            if pending is None or replica not in pending.open:
                self.choose.late(request, replica, now, answered=True)
            else:
                if means is Means.REJECTION or pending.rejection is None:
                    pending.rejection = payload
                self._rejected[request] = None
                pending.barred.add(replica)
                verdict = self._ended(request, pending, replica)
                self.choose.failed(request, replica, now, fault=False)
            means = Means.REJECTION
        return means, None, (), verdict

    def refused(self, request: bytes, replica: int, refusal: Refusal, now: float) -> Verdict:
        """Take a refusal; return POISON if the request crashed too many services."""
        pending = self._pending.get(request)
        crashed = refusal is Refusal.CRASHED and self._counts_deaths
        if crashed and self._alarms.believed(replica, now):
            self._cautious_until = now + CAUTIOUS_S
            if pending is not None and replica in pending.open:
                # If other requests ran beside it, it is only a suspect: any may be the cause. So
                # may the replica, if only it died over this request and another can be asked.
                others = {*pending.open, *self._able} - pending.died_at - pending.barred
                again = pending.died_at == {replica} and bool(others)
                alone = replica in pending.alone_at and not again
                pending.deaths = pending.deaths + 1 if alone else max(1, pending.deaths)
                pending.alone_until = (now + pending.deadline) / 2
                pending.died_at.add(replica)
        effect = refusal.effect  # for a lost link: the replica may never have seen the request
        counts, bar = Effect.BLAMELESS not in effect, Effect.FINAL in effect
        verdict = self._failed(request, pending, replica, now, counts=counts, bar=bar)
        if verdict is Verdict.LATE:
            self.choose.late(request, replica, now, answered=False)
        else:
            self.choose.failed(request, replica, now, fault=Effect.FAULT in effect)
        poison = pending is not None and pending.deaths >= POISON_DEATHS
        return Verdict.POISON if poison else verdict

    def _failed(
        self,
        request: bytes,
        pending: Pending | None,
        replica: int,
        now: float,
        *,
        counts: bool,
        bar: bool,
    ) -> Verdict:
        """Note a failed attempt: back off from the replica, doubling each time."""
        if pending is None or replica not in pending.open:
            return Verdict.LATE
        failures = pending.failures[replica] = pending.failures.get(replica, 0) + counts
        wait_s = min(2 * pending.waits.get(replica, _NO_WAIT)[1], RETRY_LIMIT_S)
        pending.waits[replica] = (now + wait_s, wait_s)
        if bar or failures >= ATTEMPTS:
            pending.barred.add(replica)
        return self._ended(request, pending, replica)

    def _ended(self, request: bytes, pending: Pending, replica: int) -> Verdict:
        del pending.open[replica]
        self._short[request] = 0.0
        return Verdict.WAIT if pending.open else Verdict.IDLE

    # -- a request ends -------------------------------------------------------------------

    def idle(self) -> list[bytes]:
        """Return the requests that have a rejected answer and no open attempt."""
        return [request for request in self._rejected if not self._pending[request].open]

    def settle(self, request: bytes, able: Iterable[int]) -> Pending | None:
        """Remove a request whose rejection is final: no other replica can be asked. Else None."""
        pending = self._pending.get(request)
        if pending is None or pending.open or pending.rejection is None:
            return None
        if any(replica not in pending.barred for replica in able):
            return None
        self._take_out(request, pending)
        return pending

    def stop(self, request: bytes, now: float) -> Pending | None:
        """Remove a request that its caller cancelled."""
        pending = self._pending.get(request)
        if pending is not None:
            self.choose.stopped(request, pending.open, now)
            self._take_out(request, pending)
        return pending

    def expire(self, now: float, *, every: bool = False) -> list[tuple[bytes, Pending]]:
        """Remove and return every request past its deadline, or all requests, oldest first."""
        if now < self.soonest_deadline and not every:
            return []
        expired = [e for e in self._pending.items() if every or e[1].deadline <= now]
        for request, pending in expired:
            self.choose.stopped(request, pending.open, now, expired=True)
            self._take_out(request, pending, over=False)
        left = (pending.deadline for pending in self._pending.values())
        self.soonest_deadline = min(left, default=NEVER)
        return expired

    def give_up(self, request: bytes, now: float) -> Pending | None:
        """Remove a request that no replica may get any more; the fallback may still answer it."""
        pending = self._pending.get(request)
        if pending is not None:
            self._alarms.were_right(pending.died_at)
            self.choose.stopped(request, pending.open, now)
            self._take_out(request, pending, over=False)
        return pending

    def fallback_answered(
        self, request: bytes, now: float, *, ok: bool
    ) -> tuple[Pending | None, bool]:
        """Take the fallback's answer; return the request it ends, if any, and whether overdue."""
        assert self.fallback is not None
        overdue = self.fallback.answered(request)
        if overdue is not None or not ok:
            return overdue, True
        pending = self._pending.get(request)
        if pending is None or now >= pending.deadline:
            return None, False
        return self.stop(request, now), False

    def _take_out(self, request: bytes, pending: Pending, *, over: bool = True) -> None:
        """Remove a request; unless it is `over`, the fallback may still answer it."""
        del self._pending[request]
        self._short.pop(request, None)
        self._rejected.pop(request, None)
        self.held_bytes -= len(pending.payload)
        if not self.decide.takes_any:
            self.decide.closed(request, pending)
        if over and self.fallback is not None:
            self.fallback.ended(request)
