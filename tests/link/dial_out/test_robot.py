"""Replicas that dial the robot: links, requests and faults are as with any other replica."""

from __future__ import annotations

import contextlib
import logging
import random
import resource
import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterator

import pytest

from fogft.link.dial_out.replica import WAITING, DialOut
from fogft.link.dial_out.robot import PURPOSE, SIGN, DialIn
from fogft.model.credentials import CredentialPaths
from fogft.model.names import host_and_port
from fogft.model.replica import LinkState, ReplicaId
from fogft.records import frames
from fogft.records.signing import Signer, Verifier
from tests.fakes.threads import no_more
from tests.link.wire_pool import POOL_UID, SERVICE, Authority, request_id, wait_for
from tests.records import hostile

ID = ReplicaId(POOL_UID, 0, 1)


@pytest.fixture
def door(authority: Authority) -> Iterator[DialIn]:
    authority.robot()
    made = DialIn("127.0.0.1:0", POOL_UID, Verifier(authority.folder / "ca.crt"))
    yield made
    made.close()


@pytest.fixture
def dial_out(authority: Authority) -> Iterator[Callable[..., DialOut]]:
    made: list[DialOut] = []

    def start(local: str, *doors: str, files: CredentialPaths | None = None) -> DialOut:
        files = files or authority.replica()
        made.append(DialOut(local, POOL_UID, Signer(files.certificate, files.key)))
        made[-1].follow(doors)
        return made[-1]

    yield start
    for one in made:
        one.close()


def test_requests_flow_to_a_replica_that_dialled(door, dial_out, start_replica, dial, owner):
    """Small and large ones; the robot dials nothing but its own loopback.

    A moment in which no thread can be started costs only the connections made in it.
    """
    replica = start_replica()
    with no_more(), pytest.raises(OSError, match="thread"):
        door.local(ID)
    with no_more(), socket.create_connection(host_and_port(door.endpoint)) as refused:
        refused.settimeout(30)
        assert refused.recv(1) == b""
    dial_out(replica.endpoint, door.endpoint)
    wait_for(lambda: door.waiting().get(ID) == WAITING)
    local = door.local(ID)
    with no_more(), socket.create_connection(host_and_port(local)) as refused:
        refused.settimeout(30)
        assert refused.recv(1) == b""
    link = dial(local)
    wait_for(lambda: link.usable)
    payloads = [b"small", bytes(range(256)) * 8000, b""]
    for number, payload in enumerate(payloads):
        assert link.offer(SERVICE, request_id(number), payload, 20.0)
    wait_for(lambda: len(owner.answers) == len(payloads))
    for number, payload in enumerate(payloads):
        assert [a.payload for a in owner.of(number)] == [payload]
    wait_for(lambda: door.waiting().get(ID) == WAITING)  # another took the used one's place


def test_a_relaunched_replica_comes_in_anew_and_the_link_goes_on(
    authority, door, dial_out, start_replica, dial, owner
):
    """Killed with its connections, and started elsewhere: the link needs nothing done."""
    replica = start_replica()
    out = dial_out(replica.endpoint, door.endpoint)
    link = dial(door.local(ID))
    wait_for(lambda: link.usable)
    out.close()
    replica.kill()
    wait_for(lambda: link.status().state is LinkState.SUSPECT)
    again = start_replica()
    dial_out(again.endpoint, door.endpoint)
    wait_for(lambda: link.usable)
    assert link.offer(SERVICE, request_id(1), b"again", 20.0)
    wait_for(lambda: owner.of(1))
    assert owner.of(1)[0].payload == b"again"


@pytest.mark.own_process
def test_a_loopback_port_outlives_a_moment_without_descriptors(door):
    """Else its replica would be left out for good, however often the link tries."""
    host, _, port = door.local(ID).rpartition(":")
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.socket() as caller:
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
        try:
            caller.connect((host, int(port)))
            wait_for(lambda: door.counters().get("accept_failed"))
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        caller.settimeout(30)
        assert caller.recv(1) == b""  # taken, and given up since no replica waits there


def test_a_replica_waits_for_a_door_that_is_not_there_yet(
    authority, dial_out, start_replica, dial, caplog
):
    """It says what is wrong meanwhile, and comes in once the robot is there."""
    caplog.set_level(logging.INFO)
    replica = start_replica()
    with socket.socket() as kept:  # bound and deaf, so that nobody else takes the port meanwhile
        kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        kept.bind(("127.0.0.1", 0))
        endpoint = f"127.0.0.1:{kept.getsockname()[1]}"
        dial_out(replica.endpoint, endpoint)
        wait_for(lambda: "refused" in caplog.text.lower())
    late = DialIn(endpoint, POOL_UID, Verifier(authority.folder / "ca.crt"))
    try:
        wait_for(lambda: late.waiting().get(ID))
        wait_for(lambda: f"door_reached door={endpoint}" in caplog.text)
        link = dial(late.local(ID))
        wait_for(lambda: link.usable)
    finally:
        late.close()


def test_a_door_that_closes_is_left_and_nothing_lingers(door, dial_out, start_replica, dial):
    replica = start_replica()
    out = dial_out(replica.endpoint, door.endpoint)
    link = dial(door.local(ID))
    wait_for(lambda: link.usable)
    link.close()
    door.close()
    out.close()
    wait_for(
        lambda: not [t for t in threading.enumerate() if t.name in ("fogft-tunnel", "fogft-door")]
    )


def test_another_replica_at_the_loopback_port_is_sent_nothing(
    authority, door, dial_out, start_replica, dial
):
    """A replica comes in as what its certificate says; the link checks that once more."""
    impostor = start_replica(files=authority.replica(1), slot=0)
    dial_out(impostor.endpoint, door.endpoint)  # greets as slot 0, with slot 0's key
    link = dial(door.local(ID))
    wait_for(lambda: "has the certificate of" in link.status().detail)
    assert not {"requests", "probes"} & set(impostor.ask())


# -- hostile ------------------------------------------------------------------------------------


def test_nobody_but_a_replica_of_the_pool_comes_in(authority, door, tmp_path):
    """Robots, misnamed ones, and those of another pool or time are counted by reason."""
    expected: Counter[str] = Counter()
    for files, event in hostile.impostors(authority, tmp_path):
        with hostile.greet(door.endpoint, files) as link:
            assert link.recv(1) == b""
        expected[event] += 1
    assert door.counters() == expected
    assert door.waiting() == {}


def test_a_revoked_replica_does_not_come_in(authority):
    name = ID.certificate_name
    files = authority.replica()
    door = DialIn("127.0.0.1:0", POOL_UID, Verifier(files.ca), revoked=lambda: {name})
    with hostile.greet(door.endpoint, files) as link:
        assert link.recv(1) == b""
    assert door.counters() == {"greeting_revoked": 1}
    door.close()


def test_noise_replays_and_hoarding_are_turned_away(authority, door, dial_out, start_replica, dial):
    """The door stays open to the right ones throughout."""
    files = authority.replica()
    for noise in [b"", b"\x00" * 100, b"\xff" * 5000, frames.frame({"type": "greeting", "v": 9})]:
        link, _ = hostile.come(door.endpoint)
        with link, contextlib.suppress(OSError):
            link.sendall(noise)
            link.shutdown(socket.SHUT_WR)
            while link.recv(4096):
                pass
    wait_for(lambda: door.counters().get("greeting_malformed") == 2)
    wait_for(lambda: door.counters().get("greeting_version") == 1)
    first, nonce = hostile.come(door.endpoint)
    second, _ = hostile.come(door.endpoint)
    overheard = frames.proof_bytes(PURPOSE, nonce, POOL_UID.encode())
    with first, second:
        second.sendall(frames.greeting(*Signer(files.certificate, files.key)(overheard)))
        assert second.recv(1) == b""
    assert door.counters()["greeting_forged"] == 1
    with hostile.greet(door.endpoint, files, purpose="rendezvous") as link:
        assert link.recv(1) == b""
    assert door.counters()["greeting_forged"] == 2
    other = authority.replica(1)
    hoard = [hostile.greet(door.endpoint, other) for _ in range(8)]
    wait_for(lambda: door.counters().get("refused_full", 0) >= 4)
    odd = hostile.greet(door.endpoint, authority.replica(2))
    odd.sendall(b"not a sign of life")
    with contextlib.suppress(ConnectionError):
        while odd.recv(64):
            pass
    replica = start_replica()
    dial_out(replica.endpoint, door.endpoint)
    link = dial(door.local(ID))
    wait_for(lambda: link.usable)
    for one in (*hoard, odd):
        one.close()


def test_a_stranger_at_the_loopback_port_gets_no_further_than_the_replicas_tls(
    door, dial_out, start_replica, dial, owner
):
    """Somebody else on the robot's machine; what he sends is counted at the replica."""
    replica = start_replica()
    dial_out(replica.endpoint, door.endpoint)
    link = dial(door.local(ID))
    wait_for(lambda: link.usable)
    dice = random.Random(3)
    for number, make in enumerate(hostile.JUNK.values(), 1):
        wait_for(lambda: door.waiting().get(ID))  # else he would be sent away at the door
        hostile.throw(door.local(ID), make(dice))
        wait_for(lambda number=number: replica.count("handshakes_refused") == number)
    assert link.offer(SERVICE, request_id(1), b"x", 20.0)
    wait_for(lambda: owner.of(1))
    assert owner.of(1)[0].payload == b"x"


def test_a_replica_that_takes_no_part_after_greeting_is_dropped(authority, door):
    """It neither sends signs of life nor hangs up: a frozen one, or a black hole."""
    with hostile.greet(door.endpoint, authority.replica()) as link:
        wait_for(lambda: door.waiting().get(ID) == 1)
        wait_for(lambda: not door.waiting())
        assert link.fileno() >= 0


def test_one_that_sends_nothing_but_signs_of_life_is_dropped(authority, door):
    """It would keep the robot busy for ever."""
    with hostile.greet(door.endpoint, authority.replica()) as link:
        wait_for(lambda: door.waiting().get(ID) == 1)
        with contextlib.suppress(OSError):
            while True:
                link.sendall(SIGN * 1000)
        wait_for(lambda: not door.waiting())


def test_a_replica_survives_whatever_answers_at_a_door(authority, dial_out, caplog):
    """Noise, silence and closing doors: it says so and tries on, and so anew if told again."""
    caplog.set_level(logging.INFO)
    noisy = socket.create_server(("127.0.0.1", 0))
    stop = threading.Event()

    def serve() -> None:
        while not stop.is_set():
            try:
                link, _ = noisy.accept()
            except OSError:
                return
            with link:
                link.sendall(b"\xff" * 500)

    threading.Thread(target=serve, daemon=True).start()
    endpoint = f"127.0.0.1:{noisy.getsockname()[1]}"
    out = dial_out("127.0.0.1:1", endpoint)
    wait_for(lambda: "bytes" in caplog.text)
    out.follow(())
    caplog.clear()
    out.follow((endpoint,))
    wait_for(lambda: "bytes" in caplog.text)
    stop.set()
    noisy.close()
