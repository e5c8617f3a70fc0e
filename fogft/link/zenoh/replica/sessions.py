"""Which certificate holder a connection belongs to, and whether it is still admitted.

TLS has let the connection in; but Zenoh does not tell a listener whose query it hands over.
So each connection greets: it sends its certificate, and a signature over its own random
token and this replica's name. From then on the token, which only the two ends know, stands
for the holder. A holder who is revoked is let in no more, whatever connections are open.

Owns: which tokens are good, and whose. Not here: signatures (`signing`), TLS (`config`).
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Collection

from fogft.link import frame
from fogft.link.frame import Greeting
from fogft.model.credentials import Holder, Role, holder_of
from fogft.model.refusal import Refusal
from fogft.records.record import RecordError, Verify

HOLDERS_LIMIT = 256
TOKENS_LIMIT = 64  # of one holder: nobody's connections push out another's
_MAY_ASK = frozenset({Role.ROBOT, Role.GATEWAY})


class NotAdmittedError(Exception):
    """A connection is not admitted."""

    def __init__(self, refusal: Refusal, detail: str) -> None:
        super().__init__(detail)
        self.refusal = refusal


class AuthenticatedSessions:
    """The connections that were authenticated. Any thread."""

    def __init__(self, pool_uid: str, replica: str, verify: Verify) -> None:
        self._pool_uid = pool_uid
        self._replica = replica
        self._verify = verify
        self._lock = threading.Lock()
        self._tokens: dict[bytes, str] = {}
        self.admits = self._tokens.__contains__  # whether a token is let in; asked for each request
        self._holders: OrderedDict[str, OrderedDict[bytes, None]] = OrderedDict()
        self.revoked: frozenset[str] = frozenset()  # common names that are let in no more

    def greet(self, greeting: Greeting) -> None:
        """Let a connection in. Raises NotAdmittedError: its holder may not ask here."""
        if not greeting.certificate:
            if greeting.token not in self._tokens:
                raise NotAdmittedError(Refusal.NOT_ADMITTED, "a connection that did not greet")
            return
        message = frame.greeted_bytes(greeting.token, self._replica)
        try:
            writer = self._verify(greeting.certificate, greeting.signature, message)
            holder = holder_of(writer.common_name)
        except RecordError as error:
            expired = error.reason == "expired"
            raise NotAdmittedError(
                Refusal.EXPIRED_CERTIFICATE if expired else Refusal.NOT_ADMITTED, str(error)
            ) from error
        except ValueError as error:
            raise NotAdmittedError(Refusal.NOT_ADMITTED, str(error)) from error
        if holder.role.value != writer.role or holder.role not in _MAY_ASK:
            raise NotAdmittedError(Refusal.NOT_ADMITTED, f"`{writer.common_name}` may not ask")
        if holder.pool_uid != self._pool_uid:
            raise NotAdmittedError(
                Refusal.NOT_ADMITTED, f"`{writer.common_name}` is no holder here"
            )
        self._admit(greeting.token, holder)

    def _admit(self, token: bytes, holder: Holder) -> None:
        name = holder.common_name
        with self._lock:
            if name in self.revoked:
                raise NotAdmittedError(Refusal.REVOKED, f"`{name}` is revoked")
            if self._tokens.get(token, name) != name:
                raise NotAdmittedError(Refusal.NOT_ADMITTED, "a token that is another's")
            if name not in self._holders and len(self._holders) >= HOLDERS_LIMIT:
                self._forget(next(iter(self._holders)))
            tokens = self._holders.setdefault(name, OrderedDict())
            self._holders.move_to_end(name)
            tokens[token] = None
            self._tokens[token] = name
            if len(tokens) > TOKENS_LIMIT:
                oldest, _ = tokens.popitem(last=False)
                del self._tokens[oldest]

    def _forget(self, name: str) -> None:
        for token in self._holders.pop(name, ()):
            del self._tokens[token]

    def holder(self, token: bytes) -> str:
        """Return whose connection a token names; empty for nobody's."""
        return self._tokens.get(token, "")

    def revoke(self, names: Collection[str]) -> None:
        """Let these holders in no more. Names that were revoked before stay so."""
        with self._lock:
            self.revoked |= frozenset(names)
            for name in self.revoked & self._holders.keys():
                self._forget(name)
