"""ROS nodes for tests, in the shipped environment. Each ends with its test."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from fogft.ros import environment
from tests.fakes import waiting

environment.prepare(os.environ)

SET_BOOL = "std_srvs/srv/SetBool"
LIMIT_S = 30.0


def wait_for(
    condition: Callable[[], Any], what: str = "condition", limit_s: float = LIMIT_S
) -> None:
    """Return when a condition holds; fail when it does not for too long."""
    waiting.wait_for(condition, limit_s, what)


def expect_line(process: subprocess.Popen[str], line: str) -> None:
    """Read a process's next line; end the process if it is another one."""
    assert process.stdout is not None
    said = process.stdout.readline()
    if said != f"{line}\n":
        process.kill()
        process.wait()
    assert said == f"{line}\n"


@pytest.fixture
def make_node() -> Iterator[Callable[[int], Any]]:
    """Make nodes of ours in a domain."""
    from fogft.ros.node import SerialisedNode

    nodes: list[SerialisedNode] = []

    def make(domain: int) -> SerialisedNode:
        nodes.append(SerialisedNode(f"ours_{len(nodes)}", domain))
        return nodes[-1]

    yield make
    for node in nodes:
        node.close()
        assert not node.alive
