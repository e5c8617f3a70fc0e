"""`rmw_zenoh`'s key expressions, liveliness tokens and attachments. Pure.

A service is a queryable at ``domain/name/type/hash``. Servers and clients are announced by
liveliness tokens ``@ros2_lv/domain/session/node/entity/kind/enclave/namespace/node name``, plus
``/name/type/hash/QoS`` for all but nodes, with ``%`` for each slash within a part. A request and
its response carry the client's sequence number, the time of sending and the client's identifier
(GID), by which the client recognises its own response.

Source: the design document and `attachment_helpers.cpp` of ros2/rmw_zenoh.
"""

import hashlib
import struct
import threading
from typing import NamedTuple

from fogft.model import ros_names

ROOT = "@ros2_lv"
NODE, SERVER, CLIENT = "NN", "SS", "SC"
_KEEP_ALL = "::2,:,:,:,,"  # a QoS; reliable and volatile are its defaults, and left out
NO_HASH = "TypeHashNotSupported"  # what a distribution without type hashes (Humble) writes

_NODE_PARTS, _SERVICE_PARTS = 9, 13
_GID_BYTES = 16
_STAMP = slice(8, 16)  # of the attachment: between sequence number and GID
_ATTACHMENT_BYTES = (32, 33)  # without and with a byte for the GID's length


class Token(NamedTuple):
    """A liveliness token of a node, or of a service's server or client."""

    domain: int
    session: str
    node_id: str  # number of the node in its session
    id: str  # number of the entity in its session
    kind: str  # `NODE`, `SERVER` or `CLIENT`
    node: str
    namespace: str = "/"
    service: str = ""  # this and the following fields: empty for a node
    type: str = ""  # ``package/srv/Name``
    hash: str = ""

    def __str__(self) -> str:
        parts = [ROOT, str(self.domain), self.session, self.node_id, self.id, self.kind]
        parts += ["%", self.namespace.replace("/", "%"), self.node]
        if self.kind != NODE:
            parts += [self.service.replace("/", "%"), dds_type(self.type), self.hash, _KEEP_ALL]
        return "/".join(parts)

    @property
    def gid(self) -> bytes:
        """16 unique bytes. `rmw_zenoh` computes other ones, but never compares them."""
        return hashlib.md5(str(self).encode(), usedforsecurity=False).digest()


def read_token(key: str) -> Token | None:
    """Parse a token's key; None if it is not of a node or service."""
    parts = key.split("/")
    if len(parts) < _NODE_PARTS or parts[0] != ROOT or not parts[1].isdecimal():
        return None
    domain, session, node_id, id, kind = int(parts[1]), *parts[2:6]
    namespace, node = parts[7].replace("%", "/"), parts[8]
    if kind == NODE:
        return Token(domain, session, node_id, id, kind, node, namespace)
    if kind not in (SERVER, CLIENT) or len(parts) != _SERVICE_PARTS:
        return None
    type_name = ros_type(parts[10])
    if not type_name:
        return None
    service = parts[9].replace("%", "/")
    return Token(domain, session, node_id, id, kind, node, namespace, service, type_name, parts[11])


def service_key(domain: int, name: str, type_name: str, hash: str) -> str:
    """Return the key of a service of a type, ``package/srv/Name``, with a hash."""
    return f"{domain}/{name.strip('/')}/{dds_type(type_name)}/{hash}"


def dds_type(type_name: str) -> str:
    """Return ``package::srv::dds_::Name_`` for ``package/srv/Name``."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type(dds_name: str) -> str:
    """Return ``package/srv/Name`` for ``package::srv::dds_::Name_``; empty for other names."""
    parts = dds_name.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return ""
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


def request_attachment(sequence: int, sent_ns: int, gid: bytes) -> bytes:
    """Return a request's attachment: sequence number, time of sending (ns since 1970), GID."""
    return struct.pack("<qqB", sequence, sent_ns, _GID_BYTES) + gid


def response_attachment(of_request: bytes, sent_ns: int) -> bytes:
    """Return the attachment of a response: the request's number and GID, with a new time.

    An unknown form is returned unchanged, so that the client finds its number in it.
    """
    if len(of_request) not in _ATTACHMENT_BYTES:
        return of_request
    stamp = struct.pack("<q", sent_ns)
    return of_request[: _STAMP.start] + stamp + of_request[_STAMP.stop :]


def sent_by(of_request: bytes) -> tuple[bytes, int]:
    """Return who sent a request (GID) and when (ns since 1970); empty and 0 if unknown."""
    if len(of_request) not in _ATTACHMENT_BYTES:
        return b"", 0
    return of_request[-_GID_BYTES:], struct.unpack("<q", of_request[_STAMP])[0]


def may_be_same(one: str, other: str) -> bool:
    """Whether two hashes may be of the same definition: equal, or not comparable."""
    return one == other or one.partition("_")[0] != other.partition("_")[0]


class Graph:
    """The servers and clients of a domain, without those of our own session."""

    def __init__(self, own_session: str) -> None:
        self._own = own_session
        self._tokens: dict[str, Token] = {}
        self._lock = threading.Lock()

    def put(self, key: str) -> Token | None:
        """Add a token; return it if it is new and of another session."""
        token = read_token(key)
        if token is None or token.session == self._own or token.kind not in (SERVER, CLIENT):
            return None
        with self._lock:
            new = key not in self._tokens
            self._tokens[key] = token
        return token if new else None

    def drop(self, key: str) -> None:
        """Remove a token. Unknown ones are ignored."""
        with self._lock:
            self._tokens.pop(key, None)

    def _all(self) -> list[Token]:
        with self._lock:
            return list(self._tokens.values())

    def hashes(self, kind: str, name: str, type_name: str) -> list[str]:
        """Return the type hash of each server, or client, of a service; sorted."""
        wanted = (kind, name, type_name)
        return sorted(t.hash for t in self._all() if (t.kind, t.service, t.type) == wanted)

    def same_node_serves(self, what: str, service: str, client: bytes) -> str | None:
        """Return the full name of the service `what` of the node that calls a service.

        None while no client is discovered. Empty if its node has no such service, or if clients
        are on several nodes: `client` (a GID) does not tell which, because `rmw_zenoh` hashes the
        token in its own way.
        """
        tokens = self._all()
        nodes = {(t.node, t.namespace) for t in tokens if (t.kind, t.service) == (CLIENT, service)}
        if len(nodes) != 1:
            return "" if nodes else None
        node, namespace = nodes.pop()
        name = f"{namespace.rstrip('/')}/{node}/{what}"
        return name if self.servers(name) else ""

    def servers(self, service: str) -> list[str]:
        """Return the full name of each node that offers a service."""
        wanted = (SERVER, service)
        found = [t for t in self._all() if (t.kind, t.service) == wanted]
        return [f"{token.namespace.rstrip('/')}/{token.node}" for token in found]

    def hash_of(self, type_name: str) -> str:
        """Return the hash of a type in any node's token; empty if unknown."""
        found = sorted(token.hash for token in self._all() if token.type == type_name)
        return found[0] if found else ""

    def offered(self) -> dict[str, str]:
        """Return name -> type of the services that applications offer."""
        return {
            token.service: token.type
            for token in sorted(self._all(), key=str)
            if token.kind == SERVER
            and ros_names.is_application(token.node)
            and ros_names.is_of_application(token.service, token.type)
        }
