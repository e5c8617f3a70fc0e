"""Which modules a request passes on its way: the bytes of one are watched from caller to caller."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fogft.link.zenoh import threads
from fogft.link.zenoh.replica.listener import ZenohListener
from fogft.link.zenoh.robot.dialer import ZenohDialer
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.model.spec import ServiceSpec
from fogft.proxy.replica.server import ServerProxy
from fogft.proxy.replica.supervisor import Supervisor
from fogft.proxy.robot.client import ClientProxy
from fogft.proxy.robot.dispatcher import Dispatcher
from tests.fakes.ros import MemoryDomain
from tests.link.wire_pool import POOL_UID, Authority, wait_for

QUESTION, ANSWER = b"\0\1\0\0 the question", b"\0\1\0\0 the answer"
NAME, TYPE = "/asked", "p/srv/T"
SPEC = ServiceSpec(NAME, TYPE, timeout_s=60.0)

# Who hands it on. ROS's own end, which is in memory here, has three more.
CARRY = {
    *("proxy.robot.client", "proxy.robot.dispatcher", "proxy.robot.sending"),
    *("proxy.robot.delivery", "proxy.replica.responder"),
    *("link.zenoh.robot.link", "link.zenoh.robot.attempts", "link.zenoh.robot.connection"),
    *("link.zenoh.replica.listener", "link.zenoh.replica.reply_queue"),
}
# Who keeps it, or judges it, and gives it to nobody.
KEEP = {
    *("requests.pending", "requests.decide"),
    *("link.port", "link.window", "link.socket_progress", "link.compression"),
    *("proxy.replica.service_queue", "proxy.replica.known_requests"),
}


class Watch:
    """Notes the modules of fogft that are called with one of two payloads."""

    def __init__(self) -> None:
        self.on = False
        self.modules: set[str] = set()

    def __call__(self, frame: Any, event: str, arg: object) -> None:
        module = frame.f_globals.get("__name__", "")
        if not self.on or event != "call" or not module.startswith("fogft."):
            return
        code = frame.f_code
        arguments = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        if any(self._holds(frame.f_locals.get(name)) for name in arguments):
            self.modules.add(module.removeprefix("fogft."))

    def _holds(self, value: Any) -> bool:
        if isinstance(value, bytes):
            return QUESTION in value or ANSWER in value
        if isinstance(value, (tuple, list)):
            return any(map(self._holds, value[:4]))
        held = getattr(value, "payload", None) if type(value).__module__ != "builtins" else None
        return isinstance(held, bytes) and self._holds(held)


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Iterator[Watch]:
    made, note = Watch(), threads.note

    def noted() -> None:
        sys.setprofile(made)  # Zenoh's own threads begin outside of Python
        note()

    monkeypatch.setattr(threads, "note", noted)
    threading.setprofile(made)
    sys.setprofile(made)
    yield made
    made.on = False
    threading.setprofile(None)
    sys.setprofile(None)


def test_a_request_and_its_answer_pass_no_further_module(tmp_path: Path, watch: Watch) -> None:
    robot, cloud = MemoryDomain(synchronous=True), MemoryDomain(synchronous=True)
    service = cloud.node("app").serve(NAME, TYPE, lambda _, handle: service.respond(handle, ANSWER))
    authority, id = Authority(tmp_path / "ca"), ReplicaId(POOL_UID, 0, 1)
    listener = ZenohListener("127.0.0.1:0", authority.replica(), id)
    command = Supervisor("exec sleep 600", tmp_path, dict(os.environ))
    replica = ServerProxy(id, (SPEC,), listener, cloud.node, command)
    replica.start()
    dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID)
    proxy = ClientProxy(
        POOL_UID,
        robot.node(),
        dialer,
        lambda spec, respond, wake: Dispatcher(spec, respond, wake=wake),
    )
    proxy.serve([SPEC])
    member = Member(id, listener.endpoint)
    proxy.follow(Membership("p", POOL_UID, epoch=1, version=1, members=(member,)))

    def offered() -> bool:
        replica.run_once()
        proxy.run_once()
        return bool(proxy.offered)

    try:
        wait_for(offered, 60.0)
        caller, answers = robot.node("caller").client(NAME, TYPE), list[bytes]()
        watch.on = True
        caller.call(QUESTION, answers.append)
        wait_for(lambda: answers, 60.0)
        watch.on = False
    finally:
        replica.close()
        proxy.close()
        dialer.close()
    assert answers == [ANSWER]
    assert watch.modules >= CARRY
    assert watch.modules <= CARRY | KEEP
