"""Use several uplinks at once: one link per replica *and* network interface, combined into one.

A request is sent on one uplink or on all, as its service's policy says, under one id: the replica
runs it once. When an uplink is lost, its requests are resent on another one. An attempt ends as
lost only when no uplink is left.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

from fogft.link.port import (
    Answer,
    Dialer,
    Link,
    LinkEvents,
    LinkStatus,
    Peer,
    SendOptions,
)
from fogft.model import topic
from fogft.model.choices import UplinkPolicy
from fogft.model.refusal import Effect, Refusal
from fogft.model.replica import LinkState
from fogft.model.spec import ServiceSpec
from fogft.requests.load import Handling

_KEPT = 2048
_REST_S, _LONGEST_REST_S = 2.0, 300.0  # how long a lost uplink is used last: doubles
_SOON_S = 60.0  # a loss this long after the rest, or later, starts anew
_STATES = (LinkState.UP, LinkState.SUSPECT, LinkState.CONNECTING)


def choose(
    policy: UplinkPolicy, usable: Sequence[int], current: int | None
) -> tuple[Sequence[int], int | None]:
    """Return which of the usable uplinks to send a request on, and the new current uplink.

    `usable` uplinks are up and not tried for the request yet, in the pool file's order. `current`
    is the one that `failover` uses; None before the first.
    """
    if policy is UplinkPolicy.ALL or not usable:
        return usable, current
    if policy is UplinkPolicy.FAILOVER and current is not None and current in usable:
        return (current,), current
    later = [one for one in usable if current is not None and one > current]
    chosen = later[0] if policy is UplinkPolicy.FAILOVER and later else usable[0]
    return (chosen,), chosen


@dataclass
class _Attempt:
    """One accepted offer: the data to resend it, and the uplinks that carry it (`on`)."""

    service: str
    payload: bytes
    deadline: float
    handling: Handling
    on: set[int] = field(default_factory=set)
    via: object = None  # `offer` of the connection that took it last


class UplinksLink:
    """Links to one replica, one for each interface; see `port.Link`. Created by `UplinkDialer`."""

    def __init__(
        self, dialer: UplinkDialer, peer: Peer, services: Mapping[str, str], events: LinkEvents
    ) -> None:
        self._dialer = dialer
        self.peer = peer
        self._events = events
        self._lock = threading.Lock()
        self._attempts: dict[bytes, _Attempt] = {}
        self._again: list[bytes] = []  # requests on no uplink now, to be resent
        # How many uplinks may still report the end of a forgotten or answered request.
        self._may_tell: OrderedDict[bytes, int] = OrderedDict()
        self._current: int | None = None
        self._up: set[str] = set()  # interfaces whose link is up
        self._lost: dict[str, tuple[float, float]] = {}  # when, and for how long others go first
        self._closed = False
        self._links: list[Link] = []
        for interface in dialer.interfaces:
            one = replace(peer, interface=interface)
            self._links.append(dialer.inner.dial(one, services, self))

    # -- port.Link ------------------------------------------------------------------------

    @property
    def usable(self) -> bool:
        """Whether an uplink is up."""
        return any(link.usable for link in self._links)

    @property
    def ready(self) -> frozenset[str]:
        """Services that the replica reports ready, over any uplink that is up."""
        return frozenset(name for link in self._links for name in link.ready)

    @property
    def leaving(self) -> bool:
        """Whether the replica is leaving."""
        return any(link.leaving for link in self._links)

    @property
    def thin(self) -> bool:
        """Whether all uplinks were measured to be slow."""
        return all(link.thin or not link.usable for link in self._links)

    def offer(
        self,
        service: str,
        request_id: bytes,
        payload: bytes,
        remaining_s: float,
        *,
        more: bool = False,
        handling: Handling = Handling.NORMAL,
    ) -> bool:
        """Accept one attempt, or return False if no uplink accepts it. Never blocks."""
        attempt = _Attempt(service, payload, time.monotonic() + remaining_s, handling)
        with self._lock:
            if self._closed or request_id in self._attempts:
                return False
            by: Collection[int] = ()
            if service.startswith(topic.PREFIX):  # on another uplink it would overtake earlier ones
                if self._again:
                    return False
                others = (one for one in self._attempts.values() if one.service == service)
                first = next(others, attempt)
                by = frozenset(first.on)
                if any(self._links[i].offer != first.via for i in by):
                    return False  # on a new connection, too
            self._attempts[request_id] = attempt
        if self._send(request_id, attempt, by):
            return True
        with self._lock:  # if it is gone, it has ended meanwhile, and that was reported
            return self._attempts.pop(request_id, None) is None

    def _send(self, request_id: bytes, attempt: _Attempt, by: Collection[int] = ()) -> bool:
        policy = self._dialer.policies.get(attempt.service, UplinkPolicy.PREFER)
        taken = False
        usable = [i for i, link in enumerate(self._links) if link.usable and (not by or i in by)]
        while usable and not taken:
            first = [i for i in usable if policy is not UplinkPolicy.ALL and not self._rests(i)]
            chosen, current = choose(policy, first or usable, self._current)
            if policy is UplinkPolicy.FAILOVER:
                self._current = current
            for index in chosen:
                taken = self._send_on(index, request_id, attempt) or taken
            usable = [index for index in usable if index not in chosen]
        with self._lock:
            # One uplink may have been lost while the next one declined.
            if taken and not attempt.on and self._attempts.get(request_id) is attempt:
                self._again.append(request_id)
        return taken

    def _rests(self, index: int) -> bool:
        at, rest_s = self._lost.get(self._links[index].peer.interface, (0.0, 0.0))
        return time.monotonic() < at + rest_s

    def _send_on(self, index: int, request_id: bytes, attempt: _Attempt) -> bool:
        with self._lock:
            if self._attempts.get(request_id) is not attempt:
                return True  # it was answered over another uplink, or is no longer wanted
            attempt.on.add(index)
        left_s = attempt.deadline - time.monotonic()
        attempt.via = send = self._links[index].offer
        if not send(
            attempt.service, request_id, attempt.payload, left_s, handling=attempt.handling
        ):
            with self._lock:
                attempt.on.discard(index)
            return False
        with self._lock:
            ended = self._attempts.get(request_id) is not attempt
        if ended:  # while it was being sent: `forget` could not reach this uplink
            self._links[index].forget(request_id)
        return True

    def send(self) -> None:
        """Do nothing: uplinks send each request at once."""

    def forget(self, request_id: bytes) -> None:
        """Free the window of a request whose answer is no longer wanted, on every uplink."""
        with self._lock:
            attempt = self._attempts.pop(request_id, None)
            on = tuple(attempt.on) if attempt is not None else ()
            if len(on) > 1:
                self._note(request_id, len(on))
        for index in on:
            self._links[index].forget(request_id)

    def _note(self, request_id: bytes, may_tell: int) -> None:
        self._may_tell[request_id] = may_tell
        if len(self._may_tell) > _KEPT:
            self._may_tell.popitem(last=False)

    def flush(self) -> None:
        """Resend requests that lost their uplink, and send cancellations."""
        with self._lock:
            again = tuple(self._again)
        for request_id in again:
            attempt = self._attempts.get(request_id)
            if attempt is not None and not attempt.on and not self._send(request_id, attempt):
                self._end(request_id, Answer(request_id, None, Refusal.LOST, attempt.service))
        with self._lock:  # only now: until then, no message of a topic may overtake them
            del self._again[: len(again)]
        for link in self._links:
            link.flush()

    def status(self) -> LinkStatus:
        """Return the best uplink's snapshot, with the counts of all uplinks."""
        found = [link.status() for link in self._links]
        best = min(found, key=lambda s: (_STATES.index(s.state), s.silent_for_s))
        return replace(
            best,
            in_flight=sum(status.in_flight for status in found),
            reopened=sum(status.reopened for status in found),
            uplinks=tuple(
                {
                    "interface": link.peer.interface,
                    "state": status.state.value,
                    "rtt_s": status.rtt_s,
                    "detail": status.detail,
                }
                for link, status in zip(self._links, found, strict=True)
            ),
        )

    def close(self) -> None:
        """End every uplink's link. Attempts still open end with `Refusal.LOST`."""
        with self._lock:
            self._closed = True
        for link in self._links:
            link.close()
        self.flush()  # requests on no uplink find none now, and end

    # -- events of the uplinks' links (their threads) -------------------------------------

    def answered(self, link: Link, answer: Answer) -> None:
        """Take the end of an attempt on one uplink: the first answer, or the last refusal."""
        index = self._links.index(link)
        with self._lock:
            attempt = self._attempts.get(answer.request_id)
            if attempt is None:
                return
            attempt.on.discard(index)
            if answer.payload is None and attempt.on:
                return  # another uplink still carries it
            kind = answer.refusal
            elsewhere = kind is not None and Effect.OTHER_UPLINK in kind.effect
            again = elsewhere and time.monotonic() < attempt.deadline and not self._closed
            if again:
                self._again.append(answer.request_id)
        if again:
            self._events.changed(self)  # the owner calls `flush`: a callback must not send
        else:
            self._end(answer.request_id, answer)

    def _end(self, request_id: bytes, answer: Answer) -> None:
        with self._lock:
            attempt = self._attempts.pop(request_id, None)
            if attempt is None:
                return
            others = tuple(attempt.on)
            if answer.payload is not None and others:
                self._note(request_id, 0)
        for index in others:
            self._links[index].forget(request_id)
        self._events.answered(self, answer)

    def late(self, link: Link, answer: Answer) -> None:
        """Report wasted work once; a cancellation only if no other uplink may report more."""
        id = answer.request_id
        with self._lock:
            may_tell = self._may_tell.get(id, 1)
            waits = answer.refusal is Refusal.CANCELLED and may_tell > 1
            if id in self._may_tell:
                self._may_tell[id] = may_tell - 1 if waits else 0
        if may_tell and not waits:
            self._events.late(self, answer)

    def changed(self, link: Link) -> None:
        """Report that an uplink has changed; one that is lost again and again is used last.

        On a path that drops large packets a link opens, and then loses what is sent.
        """
        name, now = link.peer.interface, time.monotonic()
        if link.usable:
            self._up.add(name)
        elif name in self._up:
            self._up.discard(name)
            at, rest_s = self._lost.get(name, (now, 0.0))
            rest_s = 0.0 if now > at + 4 * rest_s + _SOON_S else rest_s
            self._lost[name] = now, min(max(_REST_S, 2 * rest_s), _LONGEST_REST_S)
        self._events.changed(self)


class UplinkDialer:
    """Makes links that use several uplinks; see `port.Dialer`."""

    def __init__(self, inner: Dialer) -> None:
        self.inner = inner
        self.adopt, self.renew, self.tell = inner.adopt, inner.renew, inner.tell
        self.certificate, self.close, self.newer = inner.certificate, inner.close, inner.newer
        # In order of preference; empty to follow the routing table.
        self.interfaces: tuple[str, ...] = ()
        self.policies: Mapping[str, UplinkPolicy] = {}
        self._options = SendOptions()

    def use(self, interfaces: Sequence[str], services: Sequence[ServiceSpec]) -> bool:
        """Set the uplinks and the options of services; return whether links must be redialled."""
        options = SendOptions.of(services)
        # Not `timed`: a service that is new or becomes stateful has its links redialled anyway.
        old = (self.interfaces, self._options.latest, self._options.plain)
        changed = (tuple(interfaces), options.latest, options.plain) != old
        self.interfaces, self._options = tuple(interfaces), options
        self.policies = {service.name: service.uplink_policy for service in services}
        self.adopt(options)
        return changed

    def dial(self, peer: Peer, services: Mapping[str, str], events: LinkEvents) -> Link:
        """Start a link; return at once. Replicas on this machine use no uplink."""
        if not self.interfaces or peer.endpoint.startswith(("127.", "[::1]")):
            return self.inner.dial(peer, services, events)
        return UplinksLink(self, peer, services, events)
