"""Who offers and who calls which service, as the liveliness tokens of one domain tell.

Owns: the tokens seen. Not here: how they come (`rmw_node`), what they say (`rmw_zenoh.naming`).
"""

from __future__ import annotations

import threading

from fogft.model import ros_names
from fogft.rmw_zenoh.naming import CLIENT, SERVER, Token, read_token

_NOT_APPLICATIONS = ("_", "fogft_")  # hidden nodes such as ros2cli's daemon, and proxies


class Graph:
    """The servers and clients of a domain, without those of one session.

    Args:
        own_session: The session that is left out.
    """

    def __init__(self, own_session: str) -> None:
        self._own = own_session
        self._tokens: dict[str, Token] = {}
        self._lock = threading.Lock()

    def put(self, key: str) -> Token | None:
        """Take a token up; return it if it is new and another session's."""
        token = read_token(key)
        if token is None or token.session == self._own or token.kind not in (SERVER, CLIENT):
            return None
        with self._lock:
            new = key not in self._tokens
            self._tokens[key] = token
        return token if new else None

    def drop(self, key: str) -> None:
        """Forget a token. Unknown ones are fine."""
        with self._lock:
            self._tokens.pop(key, None)

    def _all(self) -> list[Token]:
        with self._lock:
            return list(self._tokens.values())

    def hashes(self, kind: str, name: str, type_name: str) -> list[str]:
        """Return the type hash of each server, or client, of a service; sorted."""
        wanted = (kind, name, type_name)
        return sorted(t.hash for t in self._all() if (t.kind, t.service, t.type) == wanted)

    def hash_of(self, type_name: str) -> str:
        """Return the hash of a type as anybody here has it; empty where nobody says."""
        found = sorted(token.hash for token in self._all() if token.type == type_name)
        return found[0] if found else ""

    def offered(self) -> dict[str, str]:
        """Return name -> type of the services that applications offer."""
        return {
            token.service: token.type
            for token in sorted(self._all(), key=str)
            if token.kind == SERVER
            and not token.node.startswith(_NOT_APPLICATIONS)
            and ros_names.is_of_application(token.service, token.type)
        }
