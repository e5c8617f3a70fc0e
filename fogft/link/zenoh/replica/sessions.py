"""Which certificate holder a connection belongs to, and whether it is still admitted.

TLS has authenticated the connection, but Zenoh does not tell a listener whose query it delivers.
So each connection greets: it sends its certificate, and a signature over its own random
token and this replica's name. From then on the token, which only the two ends know, identifies
the holder. Not here: signatures (`signing`), TLS (`settings`).
"""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass

from fogft.link import frame
from fogft.model.credentials import Holder, Role, holder_of
from fogft.model.refusal import Refusal
from fogft.records.record import RecordError, Verify

HOLDERS_LIMIT = 256
TOKENS_LIMIT = 64  # connections per holder, so that no holder can evict another's
TOKENS_WITHIN_S = 10.0  # more than that many within this are refused: each costs a thread
_MAY_ASK = frozenset({Role.ROBOT, Role.GATEWAY})


class NotAdmittedError(Exception):
    """A connection is not admitted."""

    def __init__(self, detail: str, refusal: Refusal = Refusal.NOT_ADMITTED) -> None:
        super().__init__(detail)
        self.refusal = refusal


@dataclass(eq=False)
class AuthenticatedSessions:
    """The authenticated connections to the replica with this common name. Any thread."""

    pool_uid: str
    replica: str
    verify: Verify
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._tokens: dict[bytes, Holder] = {}
        self.of = self._tokens.get  # the holder of a token; None if it is not admitted
        # When each token was admitted, oldest first, by holder.
        self._holders: OrderedDict[str, OrderedDict[bytes, float]] = OrderedDict()
        self.revoked: frozenset[str] = frozenset()  # common names that are no longer admitted

    def greet(self, greeting: frame.Greeting) -> None:
        """Admit a connection. Raises NotAdmittedError: its holder may not send requests here."""
        if not greeting.certificate:
            if greeting.token not in self._tokens:
                raise NotAdmittedError("a connection that did not greet")
            return
        message = frame.greeted_bytes(greeting.token, self.replica)
        try:
            writer = self.verify(greeting.certificate, greeting.signature, message)
            holder = holder_of(writer.common_name)
        except ValueError as error:
            expired = isinstance(error, RecordError) and error.reason == "expired"
            refusal = Refusal.EXPIRED_CERTIFICATE if expired else Refusal.NOT_ADMITTED
            raise NotAdmittedError(str(error), refusal) from error
        if holder.role.value != writer.role or holder.role not in _MAY_ASK:
            raise NotAdmittedError(f"`{writer.common_name}` may not send requests")
        if holder.pool_uid != self.pool_uid:
            raise NotAdmittedError(f"`{writer.common_name}` is not a member of this pool")
        self._admit(greeting.token, holder)

    def _admit(self, token: bytes, holder: Holder) -> None:
        name = holder.common_name
        with self._lock:
            if name in self.revoked:
                raise NotAdmittedError(f"`{name}` is revoked", Refusal.REVOKED)
            if self._tokens.get(token, holder) != holder:
                raise NotAdmittedError("a token that is another's")
            if name not in self._holders and len(self._holders) >= HOLDERS_LIMIT:
                self._forget(next(iter(self._holders)))
            tokens, now = self._holders.setdefault(name, OrderedDict()), self.clock()
            self._holders.move_to_end(name)
            if token in tokens:
                return
            if len(tokens) >= TOKENS_LIMIT:
                oldest, since = next(iter(tokens.items()))
                if now - since < TOKENS_WITHIN_S:
                    raise NotAdmittedError(f"`{name}` greets too often", Refusal.OVERLOADED)
                del tokens[oldest], self._tokens[oldest]
            tokens[token], self._tokens[token] = now, holder

    def _forget(self, name: str) -> None:
        for token in self._holders.pop(name, ()):
            del self._tokens[token]

    def revoke(self, names: Collection[str]) -> None:
        """Stop admitting these holders. Earlier revocations stay in force."""
        with self._lock:
            self.revoked |= frozenset(names)
            for name in self.revoked & self._holders.keys():
                self._forget(name)
