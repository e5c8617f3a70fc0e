"""A link's health: noticed in time, never by the service's own time; every attempt ends once."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from fogft.link import probe_frames, window
from fogft.link.port import Probe
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.model.replica import LinkState
from tests.fakes.threads import no_more
from tests.link.wire_pool import SERVICE, Authority, Owner, ReplicaProcess, request_id, wait_for


def test_a_slow_service_is_never_suspected(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """A service four times as slow as the suspicion keeps its link, and answers."""
    replica = start_replica(delay_s=8.0)
    link = dial(replica.endpoint, suspect_after_s=2.0)
    wait_for(lambda: link.usable)
    before = link.status().reopened
    for number in range(3):
        assert link.offer(SERVICE, request_id(number), b"think hard", 60.0)
    wait_for(lambda: len(owner.answers) == 3)
    assert [a.payload for _, a in owner.answers] == [b"think hard"] * 3
    assert LinkState.SUSPECT not in {state for _, state in owner.states}
    assert link.status().reopened == before


def test_a_killed_replica_is_noticed_by_the_lost_connection(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Not by silence: suspicion is set so late here that it could not have helped."""
    others = {thread for thread in threading.enumerate() if "fogft-send" in thread.name}
    replica = start_replica(delay_s=3600.0)
    with no_more():
        dial(replica.endpoint).close()
        link = dial(replica.endpoint, suspect_after_s=3600.0)
        link.flush()
    assert "TasksMax" in link.status().detail
    link.flush()
    wait_for(lambda: link.usable)
    link.offer(SERVICE, request_id(1), b"", 3600.0)
    wait_for(lambda: replica.count("requests") == 1)
    with no_more():  # threads: the lost connection is closed, and the link goes on, without
        replica.kill()
        wait_for(lambda: owner.of(1))
        wait_for(
            lambda: (
                not [
                    thread
                    for thread in threading.enumerate()
                    if "fogft-send" in thread.name and thread not in others
                ]
            )
        )
    assert link.status().state is LinkState.SUSPECT
    again = start_replica(endpoint=replica.endpoint)
    wait_for(lambda: link.usable)
    assert link.offer(SERVICE, request_id(1), b"hello", 60.0)
    wait_for(lambda: len(owner.of(1)) == 2)
    assert again.count("requests") == 1


def test_a_mistake_while_a_link_is_kept_does_not_end_it(
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What the keeper calls fails before the link is up, and after; it is opened anew."""
    failing = iter([False, True, False, False, True])
    encode = probe_frames.encode_probe

    def encode_probe(probe: Probe) -> bytes:
        if next(failing, False):
            raise ZeroDivisionError
        return encode(probe)

    monkeypatch.setattr(probe_frames, "encode_probe", encode_probe)
    replica = start_replica()
    link = dial(replica.endpoint, suspect_after_s=0.5)
    wait_for(lambda: link.status().reopened >= 2)
    wait_for(lambda: link.usable)
    assert link.offer(SERVICE, request_id(1), b"still here", 20.0)
    wait_for(lambda: owner.of(1))
    assert owner.of(1)[0].payload == b"still here"


def test_a_late_answer_of_an_old_connection_is_dropped(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """The link was reopened meanwhile: the old attempt ended as lost, and stays so."""
    replica = start_replica(delay_s=3600.0)
    link = dial(replica.endpoint, suspect_after_s=0.3)
    wait_for(lambda: link.usable)
    link.offer(SERVICE, request_id(1), b"old", 60.0)
    wait_for(lambda: replica.count("requests") == 1)
    replica.signal(signal.SIGSTOP)
    wait_for(lambda: owner.of(1))
    replica.signal(signal.SIGCONT)
    wait_for(lambda: link.usable)
    replica.ask(delay_s=0.0)
    link.offer(SERVICE, request_id(2), b"new", 60.0)
    wait_for(lambda: owner.of(2))
    assert len(owner.of(1)) == 1


def test_a_change_of_readiness_arrives(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Services that stop being ready leave `ready`; the link stays up."""
    replica = start_replica()
    link = dial(replica.endpoint, suspect_after_s=0.5)
    wait_for(lambda: link.ready == {SERVICE})
    replica.ask(ready=[])
    wait_for(lambda: link.usable and link.ready == frozenset())
    replica.ask(ready=[SERVICE], draining=True)
    wait_for(lambda: link.leaving)


@pytest.mark.parametrize("seed", [1, 2])
def test_every_accepted_offer_is_answered_exactly_once(
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
    seed: int,
) -> None:
    """Whatever is killed or frozen while requests flow, no attempt ends twice or never."""
    chance = random.Random(seed)
    replica = start_replica(delay_s=0.02)
    link = dial(replica.endpoint, suspect_after_s=0.3)
    accepted: list[int] = []
    stop = threading.Event()

    def offer() -> None:
        number = 0
        while not stop.wait(0.002):
            payload = bytes(chance.choice([10, 10, 10, 200_000]))
            if link.offer(SERVICE, request_id(number), payload, chance.choice([0.05, 60.0])):
                accepted.append(number)
            number += 1

    offering = threading.Thread(target=offer)
    offering.start()
    try:
        for _ in range(4):
            wait_for(lambda: link.usable)
            goal = len(accepted) + 40
            wait_for(lambda goal=goal: len(accepted) >= goal)
            if chance.random() < 0.5:
                replica.kill()
                wait_for(lambda: not link.usable)
                replica = start_replica(endpoint=replica.endpoint, delay_s=0.02)
            else:
                replica.signal(signal.SIGSTOP)
                wait_for(lambda: not link.usable)
                replica.signal(signal.SIGCONT)
    finally:
        stop.set()
        offering.join()
    wait_for(lambda: len(owner.answers) >= len(accepted))
    link.close()
    counts = Counter(int.from_bytes(a.request_id, "big") for _, a in list(owner.answers))
    assert counts == Counter(accepted)
    assert any(a.payload is not None for _, a in owner.answers)


LEAVING = """
import sys
from pathlib import Path
from fogft.model.credentials import CredentialPaths
from fogft.link.zenoh.robot.dialer import ZenohDialer
from tests.link.wire_pool import POOL_UID, SERVICE, Owner, keys, peer, request_id, wait_for

files = CredentialPaths(*(Path(path) for path in sys.argv[1:4]))
owner = Owner()
dialer = ZenohDialer(files, robot="robot", pool_uid=POOL_UID)
link = dialer.dial(peer(sys.argv[4]), keys(0), owner)
wait_for(lambda: link.usable)
number = 0
while link.offer(SERVICE, request_id(number), b"many are open", 3600.0):
    number += 1
link.close()
"""


def test_a_process_that_closes_its_links_and_ends_at_once_ends_well(
    start_replica: Callable[..., ReplicaProcess], authority: Authority
) -> None:
    """Sessions are still closing then; a thread inside Zenoh would abort the process."""
    replica = start_replica(delay_s=3600.0)
    files = authority.robot()
    paths = [str(files.ca), str(files.certificate), str(files.key)]
    for _ in range(5):
        ended = subprocess.run(
            [sys.executable, "-c", LEAVING, *paths, replica.endpoint],
            cwd=Path(__file__).parents[4],
            capture_output=True,
            text=True,
            check=False,
        )
        assert (ended.returncode, ended.stderr) == (0, "")


def test_closing_leaves_no_thread(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Whether the link was up, refused or frozen, its threads end with it."""
    before = set(threading.enumerate())
    up, frozen = start_replica(slot=0), start_replica(slot=1)
    links = [
        dial(up.endpoint, slot=0),
        dial(frozen.endpoint, slot=1),
        dial("127.0.0.1:1", slot=2),
    ]
    wait_for(lambda: links[0].usable and links[1].usable)
    frozen.signal(signal.SIGSTOP)
    links[1].offer(SERVICE, request_id(1), bytes(3_000_000), 60.0)
    for link in links:
        link.close()
    wait_for(lambda: set(threading.enumerate()) <= before)
    assert owner.of(1)[0].payload is None


def test_who_ends_nothing_that_others_answer_is_found_out_though_probes_are_answered(
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(window, "IGNORED_AFTER_S", 0.1)
    link = dial(start_replica(delay_s=1e6).endpoint)
    wait_for(lambda: link.usable)
    for number in range(window.IGNORED_LIMIT):
        assert not link.status().ignores
        assert link.offer(SERVICE, request_id(number), b"x", 1.0)
        link.forget(request_id(number))  # another replica has answered
    wait_for(lambda: link.status().ignores)
    assert link.status().state is LinkState.UP
    assert link.status().reopened == 0
