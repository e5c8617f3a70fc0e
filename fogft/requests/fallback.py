"""When the fallback service is called, and how long its answer is awaited. Pure.

Law: a request goes to the fallback, a service on the robot, at most once, and once more at its
deadline if the fallback's earlier answer was not good; it ends once.
"""

from fogft.model.choices import FallbackSpec
from fogft.requests.decide import Pending
from fogft.requests.load import NEVER


class FallbackTimer:
    """The requests of one service that the fallback may have to answer."""

    def __init__(self, spec: FallbackSpec) -> None:
        self.spec = spec
        self._arrived: dict[bytes, float] = {}  # requests not handed over yet, oldest first
        self.submitted = self._arrived.__setitem__  # note a new request, and when it arrived
        self._handed: set[bytes] = set()
        self.failed = self._handed.discard  # the call failed: call again at the deadline
        self.not_asked = self._handed.clear  # it was replaced: call the new one at each deadline
        self._awaited: dict[bytes, tuple[float, Pending]] = {}  # past their deadline: until when

    def __len__(self) -> int:
        """Count the requests past their deadline whose fallback is awaited."""
        return len(self._awaited)

    def look_at(self, *, able: bool) -> float:
        """Return when `due` can next return requests; `able` says whether a replica is ready."""
        for arrived in self._arrived.values():  # the oldest
            if not able and self.spec.while_none_ready:
                return arrived
            return NEVER if self.spec.after_s is None else arrived + self.spec.after_s
        return NEVER

    def due(self, now: float, *, able: bool) -> list[bytes]:
        """Remove and return the requests to pass to the fallback now."""
        found = []
        while now >= self.look_at(able=able):
            request = next(iter(self._arrived))
            del self._arrived[request]
            self._handed.add(request)
            found.append(request)
        return found

    def ended(self, request: bytes) -> None:
        """Note that a replica has answered the request."""
        self._arrived.pop(request, None)
        self._handed.discard(request)

    def expired(self, request: bytes, item: Pending, now: float) -> bool:
        """Note a deadline: only the fallback counts now; return whether to call it (again)."""
        must_ask = request not in self._handed
        self._arrived.pop(request, None)
        self._handed.discard(request)
        self._awaited[request] = (now + self.spec.limit_s, item)
        return must_ask

    def answered(self, request: bytes) -> Pending | None:
        """Note the fallback's answer; return the item if the deadline had passed, once."""
        self._handed.discard(request)
        found = self._awaited.pop(request, None)
        return None if found is None else found[1]

    def given_up(self, now: float) -> list[tuple[bytes, Pending]]:
        """Remove and return the requests whose fallback was too slow as well."""
        over = [(r, item) for r, (until, item) in self._awaited.items() if until <= now]
        for request, _ in over:
            del self._awaited[request]
        return over
