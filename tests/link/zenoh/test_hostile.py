"""Whatever comes in at a replica's port: nothing ends, nothing changes, all is counted."""

from __future__ import annotations

import contextlib
import random
import ssl
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh

from fogft.link import frame
from fogft.link.zenoh import settings as config
from fogft.link.zenoh.replica.door import HOST_LIMIT
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.link.zenoh.settings import LinkSettings
from fogft.model import names
from fogft.model.refusal import Refusal
from fogft.model.replica import LinkState
from tests.link.wire_pool import (
    POOL_UID,
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    hears,
    keys,
    knows,
    peer,
    request_id,
    wait_for,
)
from tests.records import certificate_names, hostile


@pytest.fixture
def replica(start_replica: Callable[..., ReplicaProcess]) -> ReplicaProcess:
    return start_replica()


def _echo(link: ZenohLink, owner: Owner, number: int) -> None:
    assert link.offer(SERVICE, request_id(number), b"x%d" % number, 20.0)
    wait_for(lambda: owner.of(number))
    assert owner.of(number)[0].payload == b"x%d" % number


def _untouched(link: ZenohLink, before: dict[str, object], replica: ReplicaProcess) -> None:
    """The link that was up stayed up, and nobody else's bytes became a request or a probe."""
    assert link.status().state is LinkState.UP
    assert link.status().reopened == 0
    after = replica.ask()
    for event in ("requests", "replies", "malformed", "not_admitted", "failed"):
        assert after.get(event, 0) == before.get(event, 0), event


def test_bytes_that_are_no_tls_are_counted_and_change_nothing(
    replica: ReplicaProcess, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Ten connections of each kind, beside a link that is up."""
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    for number, (kind, junk) in enumerate(hostile.JUNK.items(), 1):
        before, dice = replica.ask(), random.Random(kind)
        for _ in range(10):
            hostile.throw(replica.endpoint, junk(dice))
        wait_for(lambda n=number: replica.count("handshakes_refused") == 10 * n)  # type: ignore[misc]
        _untouched(link, before, replica)
        _echo(link, owner, number)


def test_certificates_that_are_no_good_are_counted_and_change_nothing(
    authority: Authority,
    replica: ReplicaProcess,
    dial: Callable[..., ZenohLink],
    owner: Owner,
    tmp_path: Path,
) -> None:
    """None, another pool's, a replica's, a rendezvous's, a manager's, an expired one."""
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    before = replica.ask()
    stranger = Authority(tmp_path / "stranger")
    for tried, files in enumerate(hostile.certificates(authority, stranger), 1):
        hostile.is_turned_away(replica.endpoint, hostile.tls(files, authority.robot().ca))
        wait_for(lambda tried=tried: replica.count("handshakes_refused") == tried)  # type: ignore[misc]
    _untouched(link, before, replica)
    _echo(link, owner, 1)


def test_a_robot_that_talks_garbage_after_its_handshake_is_let_go(
    authority: Authority, replica: ReplicaProcess, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Its certificate is good; then come random messages, cut short, or too long."""
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    context = hostile.tls(authority.robot("eve"), authority.robot().ca)

    def ended() -> int:
        return replica.count("handshakes_refused") + replica.count("unauthenticated")

    for seed in range(6):
        before, dice, so_far = replica.ask(), random.Random(seed), ended()
        content = dice.randbytes(dice.randint(1, 2000))
        length = [len(content), 0xFFFF, 1][seed % 3]
        with hostile.connect(replica.endpoint) as raw, context.wrap_socket(raw) as connection:
            with contextlib.suppress(OSError):
                connection.sendall(struct.pack("<H", length) + content)
                connection.settimeout(30.0)
                while connection.recv(4096):
                    pass
        wait_for(lambda n=so_far: ended() > n)  # type: ignore[misc]
        _untouched(link, before, replica)
        _echo(link, owner, seed)


def test_connections_that_say_nothing_are_ended_and_keep_nobody_out(
    replica: ReplicaProcess, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """As many as are let in of one host: the open link goes on, another robot still gets in."""
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    before = replica.ask()
    with contextlib.ExitStack() as stack:
        idle = [stack.enter_context(hostile.connect(replica.endpoint)) for _ in range(HOST_LIMIT)]
        late = dial(replica.endpoint, robot="late")
        wait_for(lambda: replica.count("unauthenticated") >= HOST_LIMIT)
        wait_for(lambda: late.usable)
        for connection in idle:
            connection.settimeout(10.0)
            with contextlib.suppress(ConnectionResetError):
                assert connection.recv(1) == b""
    _untouched(link, before, replica)
    _echo(link, owner, 1)
    _echo(late, owner, 2)


def test_the_links_of_a_revoked_robot_are_ended_whatever_it_does(
    authority: Authority, replica: ReplicaProcess, dial: Callable[..., ZenohLink]
) -> None:
    """Its session is bare: it neither probes nor reads refusals, and is thrown out all the same."""
    ada = dial(replica.endpoint, robot="ada")
    wait_for(lambda: ada.usable)
    settings = config.robot_settings(peer(replica.endpoint), authority.robot("eve"), LinkSettings())
    session = zenoh.open(config.to_zenoh(settings))
    try:
        replica.ask(revoke=[certificate_names.robot(POOL_UID, "eve")])
        wait_for(lambda: replica.count("revoked_links") > 1)  # Zenoh comes back by itself
    finally:
        session.close()
    assert ada.usable
    assert ada.status().reopened == 0


def test_frames_that_cannot_be_read_are_counted_one_by_one(
    authority: Authority, replica: ReplicaProcess, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Truncated, too long, of another version, random: on every key that a replica has."""
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    settings = config.robot_settings(peer(replica.endpoint), authority.robot("eve"), LinkSettings())
    session = zenoh.open(config.to_zenoh(settings))
    messages = list(hostile.messages(0, keys(0)[SERVICE]))
    try:
        hears(session, keys(0)[SERVICE])
        knows(session, 0)
        for sent, (send, payload, attachment) in enumerate(messages, 1):
            _ = send(session, payload, attachment)
            wait_for(lambda sent=sent: replica.count("malformed") == sent)  # type: ignore[misc]
    finally:
        session.close()
    assert replica.count("failed") == 0
    assert link.status().reopened == 0
    _echo(link, owner, 1)


def test_who_did_not_greet_is_refused_and_counted(
    authority: Authority, replica: ReplicaProcess
) -> None:
    """A robot's certificate alone is not enough; neither is a greeting signed with another key."""
    settings = config.robot_settings(peer(replica.endpoint), authority.robot("eve"), LinkSettings())
    session = zenoh.open(config.to_zenoh(settings))
    ada = authority.robot("ada").certificate.read_bytes()
    forged = frame.Greeting(bytes(8), ssl.PEM_cert_to_DER_cert(ada.decode()), b"s" * 70)
    bare = frame.encode_greeting(frame.Greeting(bytes(8)))
    probe = b'{"v":%d,"robot":"ada"}' % frame.VERSION
    tries = [
        (names.slot_key(POOL_UID, 0, names.PROBE), probe, frame.encode_greeting(forged)),
        (names.slot_key(POOL_UID, 0, names.PROBE), probe, bare),
        (names.slot_key(POOL_UID, 0, names.ANSWERS), b"", bare),
    ]
    try:
        for sent, (key, payload, attachment) in enumerate(tries, 1):
            replies = list(session.get(key, payload=payload, attachment=attachment, timeout=20.0))
            assert len(replies) == 1
            assert replies[0].err is not None
            said = frame.decode_refusal(replies[0].err.payload.to_bytes())[2]
            assert said == Refusal.NOT_ADMITTED
            assert replica.count("not_admitted") == sent
        request = frame.encode_request(request_id(1), 5.0, frame.origin("ada", bytes(8)))
        hears(session, keys(0)[SERVICE])
        knows(session, 0)
        session.put(keys(0)[SERVICE], b"x", attachment=request)
        wait_for(lambda: replica.count("not_admitted") == len(tries) + 1)
    finally:
        session.close()
    assert replica.count("replies") == 0
