"""Waiting for one descriptor: any number, any state."""

from __future__ import annotations

import os
import resource
import select
import socket
import threading

import pytest

from fogft import poll


@pytest.fixture
def pair():
    ours, theirs = socket.socketpair()
    yield ours, theirs
    ours.close()
    theirs.close()


def test_it_is_ready_once_something_came_or_its_peer_left(pair):
    ours, theirs = pair
    assert not poll.is_ready(ours)
    assert poll.is_ready(ours, event=select.POLLOUT)
    theirs.sendall(b"x")
    assert poll.is_ready(ours, None)
    ours.recv(1)
    assert not poll.is_ready(ours, 0.01)
    threading.Timer(0.1, theirs.close).start()
    assert poll.is_ready(ours, 30.0)


def test_a_closed_one_is_ready_to_fail(pair):
    ours, _ = pair
    ours.close()
    assert poll.is_ready(ours, None)


def test_a_descriptor_above_those_of_select_is_waited_for(pair):
    """A container's limit is often a million of them."""
    ours, theirs = pair
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    number = 1500
    if hard != resource.RLIM_INFINITY and hard <= number:
        pytest.skip(f"this machine's hard limit is {hard} descriptors")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, number + 1), hard))
    try:
        os.dup2(ours.fileno(), number)
        try:
            assert not poll.is_ready(number)
            theirs.sendall(b"x")
            assert poll.is_ready(number)
        finally:
            os.close(number)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
