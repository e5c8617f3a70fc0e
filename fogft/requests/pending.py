"""One service's requests that await an answer, with what chooses and what decides. Pure.

Every step of a request's life is one method: it is begun, sent on, answered, refused, and
closed. Each keeps the table, the policy and the decision in step, and returns what is to be
done. Called under its owner's lock; the time is an argument.

Owns: bringing `first_response`, `choose`, `decide` and `fallback` together.
Not here: sending, delivering, counting (`fogft.proxy.robot.dispatcher`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Generic, Protocol, TypeVar

from fogft.model.refusal import Effect, Refusal
from fogft.requests.alarms import Alarms
from fogft.requests.choose import Choose
from fogft.requests.decide import Decide, Judgement, Means
from fogft.requests.fallback import FallbackTimer
from fogft.requests.first_response import FirstResponse, Pending, Verdict
from fogft.requests.load import NEVER, Load


class Item(Protocol):
    """What must be known of what is kept with a request."""

    payload: bytes


T = TypeVar("T", bound=Item)
Judged = tuple[Judgement, Pending[T] | None, Iterable[int], Verdict]


POISON_DEATHS = 2  # once beside others, and then alone: that is no chance
# So long after a death no request is at all replicas at once: another that kills would end them.
CAUTIOUS_S = 60.0
_SPREADS_AFTER_S = 1.0
_LOOK_AGAIN_S = 0.02  # at a request for which nobody says when


class PendingRequests(Generic[T]):
    """The requests of one service that await an answer.

    Args:
        counts_deaths: Whether a request may be blamed for the death of a service that has it.

    Attributes:
        fallback: When the fallback is asked; None where there never was one.
    """

    def __init__(self, choose: Choose, decide: Decide, *, counts_deaths: bool = False) -> None:
        self.table: FirstResponse[T] = FirstResponse()
        self.held_bytes = 0
        self.choose = choose
        self.decide = decide
        self.fallback: FallbackTimer[Pending[T]] | None = None
        self._counts_deaths = counts_deaths
        self._cautious_until = -NEVER
        self._alarms = Alarms()

    def get(self, request: bytes | None) -> Pending[T] | None:
        """Return a request that still awaits its answer."""
        return None if request is None else self.table.get(request)

    def use(self, choose: Choose) -> None:
        """Have another policy choose from now on; each request is put before it."""
        self.choose = choose
        self.table.reconsider()

    # -- a request begins, and is sent to replicas ----------------------------------------

    def begin(
        self, request: bytes, item: T, able: Sequence[int], *, deadline: float, now: float
    ) -> Sequence[int]:
        """Enter a request; return which replicas it goes to at once."""
        chosen = self.choose.first(request, able, now)
        if len(chosen) == len(able) > 1 and now < self._cautious_until:
            *chosen, spared = chosen
            self.choose.declined(request, spared, full=False)
        pending = self.table.register(
            request,
            deadline=deadline,
            item=item,
            replicas=chosen,
            now=now,
            complete=len(chosen) == len(able),
        )
        self.held_bytes += len(item.payload)
        self.decide.began(request, pending, able)
        return chosen

    def fallback_from(self, request: bytes, now: float, *, able: bool) -> float:
        """Note a request for the fallback; return when that may have to be asked next."""
        assert self.fallback is not None
        self.fallback.submitted(request, now)
        return self.fallback.look_at(able=able)

    def more(
        self, able: Sequence[int], now: float, *, newest_first: bool
    ) -> list[tuple[bytes, int]]:
        """Return which requests go to which further replicas now."""
        choose, steps = self.choose, []
        if choose.news:
            choose.news = False
            self.table.reconsider()
        short, soonest = self.table.short(now)
        for request, pending in short[::-1] if newest_first else short:
            choose.look_at = NEVER
            chosen, again_at = self._next_for(request, pending, able, now)
            steps += [(request, replica) for replica in chosen]
            if again_at > now:
                self.table.look_at(request, again_at)
                soonest = min(soonest, again_at)
            else:
                soonest = min(soonest, now + _LOOK_AGAIN_S)
        choose.look_at = now if choose.news else soonest
        return steps

    def _next_for(
        self, request: bytes, pending: Pending[T], able: Sequence[int], now: float
    ) -> tuple[Sequence[int], float]:
        """Return whom a request goes to now, and when to look at it again if nothing happens."""
        candidates, rests_until = self.table.candidates(pending, able, now)
        room = len(able)
        if pending.deaths:  # alone
            room = 0 if pending.open else 1
        elif now < self._cautious_until and pending.open:
            waited = now >= max(pending.open.values()) + _SPREADS_AFTER_S
            room -= len(pending.open) + (0 if waited else 1)
            candidates = candidates[: max(0, room)]
        elif not candidates:
            return (), rests_until
        if room <= 0:
            return (), now
        chosen = self.choose.more(request, pending.open, candidates, now)[:room]
        return chosen, self.choose.look_at if self.choose.look_at < NEVER else now

    def attempt(self, request: bytes, replica: int, now: float) -> Pending[T] | None:
        """Enter a further attempt; None where it is not wanted any more."""
        pending = self.table.attempt(request, replica, now)
        if pending is None:
            self.choose.declined(request, replica, full=False)
        elif pending.deaths:
            pending.alone_at = replica
        return pending

    def declined(self, request: bytes, replica: int) -> None:
        """A replica's link did not take an attempt."""
        self.table.declined(request, replica)
        self.choose.declined(request, replica, full=True)

    def came(self, replicas: Iterable[int]) -> None:
        """These replicas can be asked (again)."""
        for replica in replicas:
            self.table.came(replica)
            self.choose.forget(replica)

    def left(self, replicas: Iterable[int]) -> None:
        """These replicas cannot be asked for now."""
        for replica in replicas:
            self.choose.forget(replica)

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
    ) -> Judged[T]:
        """Take an answer.

        Returns:
            What it means; the request that it answers, None where it comes too late or is no
            success; who else is to stop working on that; what is to be done where it goes on.
        """
        if load is not None and request is not None:
            self.choose.heard(request, replica, load, now)
        pending = None if request is None else self.table.get(request)
        means = self.decide.judge(id, replica, payload, reading, pending)
        if request is None:
            return means, None, (), Verdict.LATE
        if means is Means.SUCCESS:
            pending = self.table.succeeded(request, now)
            if pending is None:
                self.choose.late(request, replica, now, answered=True)
                return means, None, (), Verdict.LATE
            for other in pending.died_at - {replica}:
                self._alarms.was_false(other, now)
            losers = self.choose.answered(request, pending.open, replica, load, now)
            self._closed(request, pending)
            return means, pending, losers, Verdict.WON
        verdict = Verdict.LATE
        if means is Means.UNDECIDED:
            verdict = self.table.failed(request, replica, now, counts=False, bar=True)
            verdict = verdict if pending is None else Verdict.WAIT
        elif means is Means.REJECTION or means is Means.WEAKER_REJECTION:
            weaker = means is Means.WEAKER_REJECTION
            kept = pending.rejection if weaker and pending is not None else None
            verdict = self.table.rejected(request, replica, payload if kept is None else kept)
            if verdict is Verdict.LATE:
                self.choose.late(request, replica, now, answered=True)
            else:
                self.choose.failed(request, replica, now, fault=False)
            means = Means.REJECTION
        return means, None, (), verdict

    def refused(self, request: bytes, replica: int, refusal: Refusal, now: float) -> Verdict:
        """Take a refusal; return POISON where so many services died that it is sent no more."""
        pending = self.table.get(request)
        crashed = refusal is Refusal.CRASHED and self._counts_deaths
        if crashed and self._alarms.believed(replica, now):
            self._cautious_until = now + CAUTIOUS_S
            if pending is not None and replica in pending.open:
                # Beside others it is but suspected: any of them may have been the cause.
                alone = replica == pending.alone_at
                pending.deaths = pending.deaths + 1 if alone else max(1, pending.deaths)
                pending.died_at.add(replica)
        verdict = self.table.failed(
            request,
            replica,
            now,
            counts=Effect.BLAMELESS not in refusal.effect,
            bar=Effect.FINAL in refusal.effect,
        )
        if verdict is Verdict.LATE:
            self.choose.late(request, replica, now, answered=False)
        else:
            self.choose.failed(request, replica, now, fault=Effect.FAULT in refusal.effect)
        poison = pending is not None and pending.deaths >= POISON_DEATHS
        return Verdict.POISON if poison else verdict

    # -- a request ends -------------------------------------------------------------------

    def settle(self, request: bytes, able: Iterable[int]) -> Pending[T] | None:
        """Take a request out whose rejection is the answer: nobody else can be asked."""
        pending = self.table.get(request)
        if pending is None or pending.open or pending.rejection is None:
            return None
        if any(replica not in pending.barred for replica in able):
            return None
        self.table.close(request)
        self._closed(request, pending)
        return pending

    def idle(self) -> list[bytes]:
        """Return the requests that nobody works on, where some were answered, if not well."""
        return self.table.idle() if self.table.has_rejected else []

    def stop(self, request: bytes, now: float) -> Pending[T] | None:
        """Take a request out that its caller does not want any more."""
        pending = self.table.close(request)
        if pending is not None:
            self._stopped(request, pending, now)
        return pending

    def expire(self, now: float) -> list[tuple[bytes, Pending[T]]]:
        """Take out every request whose deadline has come, oldest first."""
        expired = self.table.expire(now)
        for request, pending in expired:
            self._given_up(request, pending, now, expired=True)
        return expired

    def give_up(self, request: bytes, now: float) -> Pending[T] | None:
        """Take a request out that no replica is to have any more; the fallback still may."""
        pending = self.table.close(request)
        if pending is not None:
            self._alarms.were_right(pending.died_at)
            self._given_up(request, pending, now, expired=False)
        return pending

    def _given_up(self, request: bytes, pending: Pending[T], now: float, *, expired: bool) -> None:
        self.choose.stopped(request, pending.open, now, expired=expired)
        self.held_bytes -= len(pending.item.payload)
        self.decide.closed(request, pending)

    def fallback_answered(
        self, request: bytes, now: float, *, ok: bool
    ) -> tuple[Pending[T] | None, bool]:
        """Take the fallback's answer; return the request that ends, and if it was overdue."""
        assert self.fallback is not None
        overdue = self.fallback.answered(request)
        if overdue is not None or not ok:
            return overdue, True
        pending = self.table.succeeded(request, now)
        if pending is not None:
            self._stopped(request, pending, now)
        return pending, False

    def _stopped(self, request: bytes, pending: Pending[T], now: float) -> None:
        self.choose.stopped(request, pending.open, now)
        self._closed(request, pending)

    def _closed(self, request: bytes, pending: Pending[T]) -> None:
        self.held_bytes -= len(pending.item.payload)
        self.decide.closed(request, pending)
        if self.fallback is not None:
            self.fallback.ended(request)
