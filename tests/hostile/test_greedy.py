"""A robot in wrong hands takes all that its certificate gives it: others keep what is theirs."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import zenoh

from fogft.link import frame
from fogft.link.zenoh.replica.connection_reaper import LINKS_LIMIT
from fogft.link.zenoh.replica.reply_streams import Streams
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.model import names
from fogft.model.credentials import CredentialPaths
from fogft.records.signing import Signer
from tests.fakes.waiting import paced
from tests.hostile.robot import PROBE, Target, greeting, greets, session_at, target
from tests.link.wire_pool import SERVICE, Authority, Owner, ReplicaProcess, request_id, wait_for
from tests.nightly import by_day

ROOM = 40  # for sessions, at a replica
SESSIONS = 48


def test_a_robot_that_opens_all_connections_keeps_no_other_out(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
) -> None:
    """Its oldest ones are ended; who has a link keeps it, and who comes finds room."""
    replica = start_replica(sessions=ROOM)
    good = dial(replica.endpoint)
    wait_for(lambda: good.usable)
    at, eve = target(replica.endpoint), authority.robot("eve")
    with contextlib.ExitStack() as held:
        for _ in range(SESSIONS):
            with contextlib.suppress(zenoh.ZError):  # it is one too many at this moment
                held.enter_context(session_at(at, eve))
        wait_for(lambda: replica.count("surplus_links") > SESSIONS - LINKS_LIMIT)
        late = dial(replica.endpoint, robot="late", owner=Owner())
        wait_for(lambda: late.usable)
        assert good.offer(SERVICE, request_id(1), b"x", 30.0)
        wait_for(lambda: owner.of(1))
    assert good.status().reopened == 0


def test_a_robot_that_greets_under_ever_new_tokens_ends_no_other_s_answers(
    authority: Authority,
    replica: ReplicaProcess,
    good: ZenohLink,
    owner: Owner,
) -> None:
    """Those are refused beyond a number, and asking for answers under the others ends its own."""
    at, eve = target(replica.endpoint), authority.robot("eve")
    signer = Signer(eve.certificate, eve.key)
    with session_at(at, eve) as session:
        greets(session, eve, at)
        for number in range(2 * Streams.limit):
            greet(session, at, signer, number.to_bytes(8, "big"))
            if number % 100 == 0:
                assert good.offer(SERVICE, request_id(number), b"x", 30.0)
        wait_for(lambda: replica.count("not_admitted") > Streams.limit)
        wait_for(lambda: good.status().in_flight == 0)
    assert {answer.payload for _, answer in owner.answers} == {b"x"}
    assert good.status().reopened == 0


def greet(session: zenoh.Session, at: Target, signer: Signer, token: bytes) -> None:
    """Greet under a token, and ask for its answers to come; waits for neither."""
    signed = greeting(signer, at, token)
    bare = frame.encode_greeting(frame.Greeting(token))
    key, answers = names.slot_key(*at.place, names.PROBE), names.slot_key(*at.place, names.ANSWERS)
    session.get(key, lambda reply: None, payload=PROBE, attachment=signed, timeout=60.0)
    session.get(answers, lambda reply: None, attachment=bare, timeout=60.0)


def test_a_robot_that_does_nothing_but_greet_holds_up_no_other(
    authority: Authority,
    replica: ReplicaProcess,
    good: ZenohLink,
    dial: Callable[..., ZenohLink],
    owner: Owner,
) -> None:
    """Each greeting costs the replica a signature's check: others' probes are answered in time."""
    at, eve = target(replica.endpoint), authority.robot("eve")
    done = threading.Event()
    with session_at(at, eve) as session:
        greets(session, eve, at)
        threading.Thread(target=flood, args=(session, at, eve, done), daemon=True).start()
        for sent in paced(0.02, seconds=by_day(3.0, at_night=60.0)):
            assert good.offer(SERVICE, request_id(sent), b"x", 30.0)
        late = dial(replica.endpoint, robot="late", owner=Owner())
        wait_for(lambda: late.usable)
        done.set()
    wait_for(lambda: good.status().in_flight == 0)
    print(replica.ask())
    assert {answer.payload for _, answer in owner.answers} == {b"x"}
    assert good.status().reopened == 0


def flood(
    session: zenoh.Session, at: Target, files: CredentialPaths, done: threading.Event
) -> None:
    """Greet as fast as the replica takes it, waiting for nothing."""
    signed = greeting(Signer(files.certificate, files.key), at, bytes(7) + b"f")
    key = names.slot_key(*at.place, names.PROBE)
    while not done.is_set():
        with contextlib.suppress(zenoh.ZError):
            session.get(key, lambda reply: None, payload=PROBE, attachment=signed, timeout=5.0)


def test_a_robot_that_reads_nothing_and_asks_on_holds_up_no_other(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
) -> None:
    """One thread of Zenoh's, and one of ours, answer all robots: they wait for room for none."""
    replica = start_replica(reply_bytes=4 << 20)
    good = dial(replica.endpoint)
    wait_for(lambda: good.usable)
    eve = authority.robot("eve")
    paths = map(str, (eve.ca, eve.certificate, eve.key))
    command = [sys.executable, "-m", "tests.hostile.deaf", replica.endpoint, *paths]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as deaf:
        try:
            assert deaf.stdout is not None
            assert deaf.stdout.readline() == "deaf\n"
            heard_at = {
                round(time.monotonic() - (good.status().heard_age_s or 0.0))
                for _ in paced(0.1, seconds=by_day(8.0, at_night=60.0))
            }
            assert good.offer(SERVICE, request_id(100), b"x", 30.0)
            wait_for(lambda: owner.of(100))
            assert deaf.poll() is None
        finally:
            deaf.kill()
    assert len(heard_at) > 3  # its probes were answered all the time
    assert good.status().reopened == 0


def test_a_robot_asks_in_its_own_name_only(
    authority: Authority,
    replica: ReplicaProcess,
    dial: Callable[..., ZenohLink],
    owner: Owner,
) -> None:
    """What counts a robot's share, and whose order a service obeys, is its certificate's name."""
    link = dial(replica.endpoint, files=authority.robot("eve"), robot="ada")
    wait_for(lambda: link.usable)
    assert link.offer(SERVICE, request_id(1), b"who", 30.0)
    wait_for(lambda: owner.of(1))
    assert owner.of(1)[0].payload == b"eve"
