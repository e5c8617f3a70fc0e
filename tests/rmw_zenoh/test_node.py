"""A node among those of `rmw_zenoh`: what is seen of it, and what it makes of the others.

What it promises as a node of ROS is tested with the others' (`tests/contract/test_ros`).
"""

from __future__ import annotations

import contextlib
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from zenoh import handlers

from fogft.errors import RosError, Unreadable
from fogft.model.type_definition import REQUEST, RESPONSE
from fogft.rmw_zenoh.naming import CLIENT, NO_HASH, SERVER, Token, request_attachment, service_key
from fogft.rmw_zenoh.node import RmwZenohNode, settings_from
from tests.fakes import waiting
from tests.needs import needs
from tests.rmw_zenoh.rmw_router import Router

TYPE = "my_msgs/srv/Grasp"
HASH, OTHER = "RIHS01_" + "a" * 64, "RIHS01_" + "b" * 64
KEY = f"7/arm/grasp/my_msgs::srv::dds_::Grasp_/{HASH}"
BODY = b"\x00\x01\x00\x00body"
GID = bytes(range(16))
LIMIT_S = 60.0


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    return waiting.wait_for(condition, LIMIT_S, what)


@pytest.fixture
def peer(rmw_router: Router) -> Iterator[zenoh.Session]:
    """A session of somebody else."""
    session = zenoh.open(settings_from(rmw_router.environ))
    yield session
    session.close()


@pytest.fixture
def make(rmw_router: Router) -> Iterator[Callable[..., RmwZenohNode]]:
    """Make nodes in domain 7; the hash of `TYPE` is known unless told otherwise."""
    made: list[RmwZenohNode] = []

    def new(name: str = "fogft_p", known: str = HASH) -> RmwZenohNode:
        node = RmwZenohNode(
            name, 7, hashes_of=lambda _: [known] * bool(known), environ=rmw_router.environ
        )
        made.append(node)
        return node

    yield new
    for node in made:
        node.close()


def tokens(session: zenoh.Session) -> set[str]:
    replies = session.liveliness().get("@ros2_lv/7/**", timeout=LIMIT_S)
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


def ask(session: zenoh.Session, key: str, **what: Any) -> list[Any]:
    """Return the replies that came, once all have."""
    target = zenoh.QueryTarget.ALL_COMPLETE
    return list(session.get(key, target=target, timeout=LIMIT_S, **what))


def echo(node: RmwZenohNode, name: str = "/arm/grasp") -> Any:
    made: dict[str, Any] = {}
    made["server"] = node.serve(name, TYPE, lambda p, h: made["server"].respond(h, p))
    return made["server"]


def client_token(session: zenoh.Session, hash: str, name: str = "/arm/grasp") -> Any:
    token = Token(7, str(session.zid()), "0", "1", CLIENT, "robot", "/", name, TYPE, hash)
    return session.liveliness().declare_token(str(token))


def test_a_service_is_in_the_graph_while_it_is_offered(
    make: Callable[..., RmwZenohNode], peer: zenoh.Session
) -> None:
    """Node and service are told by tokens: `wait_for_service` and `ros2 service list` read them."""
    node = make()
    wait_for(lambda: len(tokens(peer)) == 1, "the node's token")
    server = echo(node)
    wait_for(lambda: len(tokens(peer)) == 2, "the service's token")
    (told,) = wait_for(lambda: [t for t in tokens(peer) if "/SS/" in t], "the service's token")
    assert told.endswith(
        f"/SS/%/%/fogft_p/%arm%grasp/my_msgs::srv::dds_::Grasp_/{HASH}/::2,:,:,:,,"
    )
    server.close()
    wait_for(lambda: len(tokens(peer)) == 1, "the service's token to be gone")


def test_a_response_carries_the_client_s_number_and_identifier(
    make: Callable[..., RmwZenohNode], peer: zenoh.Session
) -> None:
    """By them the client's middleware knows its own; one answer comes, then the end."""
    echo(make())
    attachment = request_attachment(42, 1, GID)
    replies = wait_for(lambda: ask(peer, KEY, payload=BODY, attachment=attachment), "an answer")
    (reply,) = replies
    assert reply.ok.payload.to_bytes() == BODY
    number, sent_ns, size = struct.unpack_from("<qqB", reply.ok.attachment.to_bytes())
    assert (number, size) == (42, 16)
    assert sent_ns > 1
    assert reply.ok.attachment.to_bytes()[17:] == GID


def test_bytes_of_another_shape_go_to_nobody(
    make: Callable[..., RmwZenohNode], peer: zenoh.Session, rmw_router: Router
) -> None:
    """They come from elsewhere, and may end the process of a node that reads them."""
    faults = {REQUEST: "no request", RESPONSE: "no response"}
    node = RmwZenohNode(
        "fogft_q", 7, hashes_of=lambda _: [HASH], environ=rmw_router.environ,
        fault_of=lambda type_name, part: lambda payload: faults[part] if payload == BODY else "",
    )  # fmt: skip
    with contextlib.closing(node):
        with pytest.raises(Unreadable, match="no request"):
            node.client("/arm/grasp", TYPE).call(BODY, lambda _: None)
        held: list[Any] = []
        server = node.serve("/arm/grasp", TYPE, lambda payload, handle: held.append(handle))
        # Told after the service itself, on the same way: who sees it, reaches the service.
        wait_for(lambda: any("/SS/" in token for token in tokens(peer)), "the service's token")
        attachment = request_attachment(1, 1, GID)
        peer.get(KEY, payload=BODY, attachment=attachment, timeout=LIMIT_S)
        handle = wait_for(lambda: held, "the request")[0]
        with pytest.raises(Unreadable, match="no response"):
            server.respond(handle, BODY)
        server.respond(handle, BODY + b"!")
    with pytest.raises(Unreadable, match="without the header"):
        make().client("/arm/grasp", TYPE).call(b"\0\1\0", lambda _: None)


TURN_S = 0.01


class PlainClient:
    """A client of `rmw_zenoh` with its default queue of ten, and an executor that is slow.

    In each turn the executor takes one answer and answers one request of its parameter service.
    """

    TYPES = "rcl_interfaces/srv/GetParameterTypes"

    def __init__(self, session: zenoh.Session, *, answers_probes: bool) -> None:
        self.lost = self.taken = 0
        self.longest_turn_s = 0.0
        self._session = session
        self._answers: deque[bytes] = deque(maxlen=10)
        self._probes: deque[Any] = deque()
        self._declared = [client_token(session, HASH)]
        self._open = True
        if answers_probes:
            name = "/robot/get_parameter_types"
            token = Token(7, str(session.zid()), "0", "2", SERVER, "robot", "/", name, self.TYPES)
            said = str(token._replace(hash=HASH))
            key = service_key(7, name, self.TYPES, HASH)
            held = handlers.Callback(self._probes.append, indirect=False)
            self._declared += [
                session.declare_queryable(key, held, complete=True),
                session.liveliness().declare_token(said),
            ]
        self._executor = threading.Thread(target=self._spin, daemon=True)
        self._executor.start()

    def _spin(self) -> None:
        began = time.monotonic()
        while self._open:
            time.sleep(TURN_S)  # its callback
            now = time.monotonic()
            self.longest_turn_s = max(self.longest_turn_s, now - began)
            began = now
            if self._answers:
                self._answers.popleft()
                self.taken += 1
            if self._probes:
                query = self._probes.popleft()
                query.reply(query.key_expr, BODY, attachment=query.attachment)
                query.drop()

    def _answered(self, reply: Any) -> None:
        self.lost += len(self._answers) == 10
        self._answers.append(reply.ok.payload.to_bytes())

    def burst(self, requests: int) -> None:
        """Ask at once: all bear one time, however long it takes here to send them."""
        sent_ns = time.time_ns()
        for number in range(requests):
            self._session.get(
                KEY,
                handlers.Callback(self._answered, indirect=False),
                payload=BODY,
                attachment=request_attachment(number, sent_ns, GID),
                timeout=LIMIT_S,
            )

    def close(self) -> None:
        self._open = False
        self._executor.join()
        for one in self._declared:
            one.undeclare()


def burst(node: RmwZenohNode, peer: zenoh.Session) -> PlainClient:
    """Have a new client ask 64 times at once; return it when all answers have come."""
    client = PlainClient(peer, answers_probes=True)
    with contextlib.closing(client), contextlib.closing(node):
        wait_for(lambda: node.graph.servers("/robot/get_parameter_types"), "the client's node")
        echo(node)
        wait_for(lambda: any("/SS/" in t and "grasp" in t for t in tokens(peer)), "the service")
        client.burst(64)
        wait_for(lambda: client.taken + client.lost >= 64, "all answers")
    return client


def test_a_burst_of_a_plain_client_loses_no_answer(
    make: Callable[..., RmwZenohNode], peer: zenoh.Session
) -> None:
    """Its executor takes one in 10 ms; what its queue has no room for waits here.

    Where the machine held that executor up, it was a slower client: another one asks.
    """
    for _ in range(5):
        client = burst(make(), peer)
        if not client.lost or client.longest_turn_s < 2 * TURN_S:
            break
    assert (client.taken, client.lost) == (64, 0)


def test_what_is_not_answered_ends_without_a_reply(
    make: Callable[..., RmwZenohNode], peer: zenoh.Session
) -> None:
    """A request that nobody holds any more, or that is none, leaves no client waiting."""
    seen: list[bytes] = []
    make().serve("/arm/grasp", TYPE, lambda payload, handle: seen.append(payload))
    attachment = request_attachment(1, 1, GID)
    wait_for(lambda: ask(peer, KEY, payload=BODY, attachment=attachment) or seen, "the request")
    assert ask(peer, KEY, payload=BODY, attachment=attachment) == []
    assert ask(peer, KEY, payload=BODY) == []  # no attachment
    assert ask(peer, KEY, attachment=attachment) == []  # no request
    assert set(seen) == {BODY}


def test_whoever_offers_the_same_service_is_named(make: Callable[..., RmwZenohNode]) -> None:
    first, second = echo(make("fogft_p")), echo(make("fogft_q"))
    wait_for(first.mismatch, "the second")
    assert "`/arm/grasp` is also offered by `/fogft_q`" in first.mismatch()
    second.close()
    wait_for(lambda: not first.mismatch(), "its end")


def test_a_service_is_offered_under_the_hash_that_its_client_has(
    make: Callable[..., RmwZenohNode], peer: zenoh.Session
) -> None:
    """Humble has no hashes, and its name for that is part of its keys."""
    echo(make())
    held = client_token(peer, NO_HASH)  # a token that nobody holds is withdrawn
    humble = KEY.replace(HASH, NO_HASH)
    attachment = request_attachment(1, 1, GID)
    wait_for(lambda: ask(peer, humble, payload=BODY, attachment=attachment), "an answer")
    held.undeclare()


def test_a_client_with_another_definition_is_told_in_the_log_and_not_answered(
    make: Callable[..., RmwZenohNode], peer: zenoh.Session, caplog: pytest.LogCaptureFixture
) -> None:
    """Its bytes would be read as another message."""
    echo(make())
    held = client_token(peer, OTHER)
    wait_for(lambda: "type_differs" in caplog.text, "the message")
    assert not any(OTHER in token for token in tokens(peer) if "/SS/" in token)
    held.undeclare()


def test_one_who_tells_another_hash_moves_the_service_only_until_others_tell(
    peer: zenoh.Session, rmw_router: Router
) -> None:
    """Who is heard first may lie; of equally many, they count whom a client agrees with."""
    said, held = [OTHER], client_token(peer, HASH)
    node = RmwZenohNode("fogft_q", 7, hashes_of=lambda _: said, environ=rmw_router.environ)
    with contextlib.closing(node):
        echo(node)
        said.append(HASH)
        attachment = request_attachment(1, 1, GID)

        def asked() -> list[Any]:
            node.look()
            return ask(peer, KEY, payload=BODY, attachment=attachment)

        wait_for(asked, "an answer")
        assert not any(OTHER in token for token in tokens(peer))
    held.undeclare()


def test_a_client_tells_the_hash_that_nobody_knew(
    make: Callable[..., RmwZenohNode], peer: zenoh.Session
) -> None:
    """Without a hash there is no key to offer a service under; a client's is as good as any."""
    node = make(known="")
    with pytest.raises(RosError, match="hash of `my_msgs/srv/Grasp` is not known"):
        echo(node)
    held = client_token(peer, HASH)
    wait_for(lambda: node.graph.hash_of(TYPE) == HASH, "the client's token")
    echo(node)
    attachment = request_attachment(1, 1, GID)
    wait_for(lambda: ask(peer, KEY, payload=BODY, attachment=attachment), "an answer")
    held.undeclare()


def test_noise_in_the_graph_is_left_out(
    make: Callable[..., RmwZenohNode], peer: zenoh.Session
) -> None:
    """Proxies, hidden nodes, ROS's own services and tokens of no known form are not offered."""
    live, id = peer.liveliness(), str(peer.zid())
    noise = [
        *("@ros2_lv/7/x", "@ros2_lv/7/a/b/c/SS/d/e/f/g/h/i/j", "@ros2_lv/7/a/b/c/XX/d/e/f"),
        str(Token(7, id, "0", "2", SERVER, "fogft_q", "/", "/a", TYPE, HASH)),
        str(Token(7, id, "0", "3", SERVER, "_hidden", "/", "/b", TYPE, HASH)),
        str(Token(7, id, "0", "4", SERVER, "n", "/", "/c", "rcl_interfaces/srv/Get", HASH)),
        str(Token(8, id, "0", "5", SERVER, "n", "/", "/d", TYPE, HASH)),
        str(Token(7, id, "0", "6", SERVER, "n", "/", "/wanted", TYPE, HASH)),
    ]
    held = [live.declare_token(key) for key in noise]
    node = make()
    wait_for(lambda: node.offered() == {"/wanted": TYPE}, "the application's service")
    assert node.alive
    for token in held:
        token.undeclare()
    wait_for(lambda: node.offered() == {}, "it to be gone")


def test_the_router_may_die_and_come_back(
    make: Callable[..., RmwZenohNode], rmw_router: Router
) -> None:
    """Those who have met go on without it; when it is back, newcomers are found."""
    echo(make("fogft_server"))
    client = make("fogft_client").client("/arm/grasp", TYPE)
    wait_for(client.available, "discovery")
    answers: list[bytes] = []
    client.call(BODY, answers.append)
    wait_for(lambda: len(answers) == 1, "an answer")
    rmw_router.kill()
    client.call(BODY, answers.append)
    wait_for(lambda: len(answers) == 2, "an answer without the router")
    rmw_router.start()
    newcomer = make("fogft_newcomer").client("/arm/grasp", TYPE)
    wait_for(newcomer.available, "discovery by the new router")
    newcomer.call(BODY, answers.append)
    wait_for(lambda: len(answers) == 3, "an answer to the newcomer")


def test_the_environment_s_mistakes_are_said(tmp_path: Path) -> None:
    cases = {
        "ZENOH_CONFIG_OVERRIDE": ("no/such/key=1", "`ZENOH_CONFIG_OVERRIDE` cannot be used at"),
        "ZENOH_SESSION_CONFIG_URI": (str(tmp_path / "none.json5"), "none.json5` cannot be used"),
        "ROS_DOMAIN_ID": ("seven", "`ROS_DOMAIN_ID=seven` is not a ROS domain"),
    }
    for name, (value, message) in cases.items():
        with pytest.raises(RosError, match=message):
            RmwZenohNode("fogft_p", environ={name: value})


@needs("pyzeros")
def test_names_are_those_of_another_implementation(peer: zenoh.Session) -> None:
    """`pyzeros` and we write the same keys and tokens."""
    from pyzeros.pub import publisher_keyexpr
    from pyzeros.qos import QosProfile
    from pyzeros.service_common import token_keyexpr

    from fogft.rmw_zenoh.naming import dds_type, service_key

    dds = dds_type(TYPE)
    assert service_key(7, "/arm/grasp", TYPE, HASH) == publisher_keyexpr(
        name="/arm/grasp", dds_type=dds, hash=HASH, namespace="/", domain_id=7
    )
    for kind in (SERVER, CLIENT):
        ours = Token(7, "abc", "0", "4", kind, "n", "/ns", "/arm/grasp", TYPE, HASH)
        quality = QosProfile(history="keep_all", depth=0)
        assert str(ours) == token_keyexpr(
            kind, "/arm/grasp", dds, HASH, quality, "n", peer, 7, "/ns",
            _node_id="0", _zenoh_id="abc", _entity_id="4",
        )  # fmt: skip
