"""ROS domains and ports belong to one machine at a time, on the whole computer."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

from fogft.ros.reservations import (
    DOMAINS,
    reserve_domain,
    reserve_port,
)
from tests.fakes.waiting import wait_for

CHECKOUT = Path(__file__).parents[2]
EVERY = set(DOMAINS)


def test_a_domain_is_given_once_and_again_after_its_release():
    mine = reserve_domain()
    assert mine is not None
    others = EVERY - {mine.number}
    assert reserve_domain(others) is None
    mine.release()
    wait_for(lambda: (again := reserve_domain(others)) and (again.release(), True))


def test_a_domain_of_another_process_is_not_given_until_that_ends():
    code = (
        "from fogft.ros.reservations import reserve_domain\n"
        "kept = reserve_domain(); print(kept.number, flush=True); input()"
    )
    pipe = subprocess.PIPE
    other = subprocess.Popen([sys.executable, "-c", code], cwd=CHECKOUT, stdin=pipe, stdout=pipe)
    with other:
        number = int(other.stdout.readline())
        assert reserve_domain(EVERY - {number}) is None
        other.kill()
    wait_for(lambda: (got := reserve_domain(EVERY - {number})) and (got.release(), True))


def test_a_domain_whose_ports_are_bound_is_not_given():
    """A participant that never asked us is found by what it listens on."""
    free = reserve_domain()
    free.release()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("127.0.0.1", 7400 + 250 * free.number + 11))
        assert reserve_domain(EVERY - {free.number}) is None


def test_a_port_on_which_somebody_listens_is_not_given(monkeypatch):
    mine = reserve_port()
    with socket.create_server(("127.0.0.1", mine.number)):
        mine.release()
        monkeypatch.setattr("fogft.ros.reservations.PORTS", [mine.number])
        assert reserve_port() is None
    monkeypatch.setattr("fogft.ros.reservations.PORTS", [mine.number])
    wait_for(lambda: (got := reserve_port()) and (got.release(), True))
