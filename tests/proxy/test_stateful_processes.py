"""Stateful services on real proxies: kills of every kind, histories checked, states compared."""

from __future__ import annotations

import contextlib
import os
import random
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fogft.ros import environment
from tests.nightly import by_day
from tests.ordering.linearizability import Call, counter, key_value, linearizable
from tests.proxy.by_hand import LIMIT_S, ROOT, Parts, Replica, Robot, wait_for

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]
environment.prepare(os.environ)

TIMEOUT_S = 40.0
# How long a caller waits: longer than the proxy, but where the proxy itself was killed.
GIVE_UP_S, GIVE_UP_KILLED_S = 50.0, 3.0
PACE_S = 0.1  # between an answer and the next question: what is seen needs no full processors
NODE = ROOT / "tests/proxy/nodes/stateful_node.py"
_END = "type: nav_msgs/srv/{}Map, field: map.data"


def _stateful(name: str, type_name: str) -> str:
    ends = ", ".join(
        f"{end}: {{name: {name}/{verb}_state, {_END.format(verb.title())}}}"
        for end, verb in (("snapshot", "get"), ("restore", "set"))
    )
    return f"{{name: {name}, type: {type_name}, timeout_s: {TIMEOUT_S}, state: {{{ends}}}}}"


TYPES = {"/count": "std_srvs/srv/SetBool", "/store": "nav_msgs/srv/LoadMap"}
SERVICES = f"[{', '.join(_stateful(*entry) for entry in TYPES.items())}]"


class Client:
    """Asks one question after another, on a thread of its own, and writes down what it saw."""

    def __init__(self, domain: int, name: str, question: Callable[[], Any]) -> None:
        from nav_msgs.srv import LoadMap
        from rclpy.serialization import deserialize_message, serialize_message
        from std_srvs.srv import SetBool

        from fogft.ros.node import SerialisedNode

        self.history: list[Call] = []
        self.answered = 0
        self.patience_s = GIVE_UP_S
        self._types = {"/count": SetBool, "/store": LoadMap}
        self._read, self._write = deserialize_message, serialize_message
        self._name, self._question = name, question
        self._node = SerialisedNode("client", domain)
        self._client = self._node.client(name, TYPES[name])
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> Client:
        wait_for(self._client.available, f"{self._name} to be found")
        # Discovery may know one way before the other: the first answer may never arrive.
        reading = ("get", 0) if self._name == "/count" else ("get", "a")
        wait_for(lambda: self.ask(reading, 0.5) is not None, "a first answer")
        self.history.clear()
        self.answered = 0
        self._thread.start()
        return self

    def _run(self) -> None:
        while not self._stop.is_set():
            self.ask(self._question())
            self._stop.wait(PACE_S)

    def ask(self, asked: Any, limit_s: float | None = None) -> Any:
        """Ask once; None if no answer came in time."""
        came, answer = threading.Event(), []

        def on_response(payload: bytes) -> None:
            answer.append((time.monotonic(), payload))
            came.set()

        began = time.monotonic()
        ticket = self._client.call(bytes(self._write(self._request(asked))), on_response)
        while not came.wait(0.05) and time.monotonic() < began + (limit_s or self.patience_s):
            pass
        if not came.is_set():
            self._client.forget(ticket)
            self.history.append(Call(began, asked))
            return None
        ended, payload = answer[0]
        value = self._value(self._read(payload, self._types[self._name].Response))
        self.history.append(Call(began, asked, ended, value))
        self.answered += 1
        return value

    def given_up(self) -> list[float]:
        """Return until when each call was waited for, at least: the next one came then."""
        return [*(call.began for call in self.history[1:]), time.monotonic()][: len(self.history)]

    def _request(self, asked: Any) -> Any:
        if self._name == "/count":
            return self._types[self._name].Request(data=asked[0] == "add")
        return self._types[self._name].Request(map_url=" ".join(map(str, asked)))

    def _value(self, response: Any) -> int:
        return int(response.message if self._name == "/count" else response.map.header.frame_id)

    def go_on(self) -> None:
        """Ask again after `stop`."""
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(LIMIT_S)

    def close(self) -> None:
        self.stop()
        self._node.close()


def state_of(replica: Replica) -> tuple[bytes, bytes]:
    """Ask a replica's own services for their states, past every proxy."""
    from nav_msgs.srv import GetMap
    from rclpy.serialization import deserialize_message, serialize_message

    from fogft.ros.node import SerialisedNode

    node = SerialisedNode("looking", replica.domain)
    states = []
    try:
        for name in ("/count", "/store"):
            client = node.client(f"{name}/get_state", "nav_msgs/srv/GetMap")
            wait_for(client.available, f"{name}/get_state")
            came, answer = threading.Event(), []

            def ask(client=client, a=answer, c=came) -> bool:
                """An ordinary service may drop the answer to a client that it has just met."""
                client.call(
                    bytes(serialize_message(GetMap.Request())),
                    lambda payload: (a.append(payload), c.set()),
                )
                return c.wait(2.0)

            wait_for(ask, f"{name}/get_state to answer")
            states.append(deserialize_message(answer[0], GetMap.Response).map.data.tobytes())
    finally:
        node.close()
    return states[0], states[1]


@pytest.fixture
def parts(tmp_path: Path, ros_domains: Callable[[], int]) -> Iterator[Parts]:
    made = Parts(tmp_path, ros_domains, services=SERVICES, node=NODE)
    yield made
    made.close()


@pytest.fixture
def clients() -> Iterator[Callable[[Robot, str, Callable[[], Any]], Client]]:
    made: list[Client] = []

    def start(robot: Robot, name: str, question: Callable[[], Any]) -> Client:
        made.append(Client(robot.domain, name, question))
        return made[-1].start()

    yield start
    for client in made:
        client.close()


def fully_ready(robot: Robot) -> list[int]:
    return sorted(link["slot"] for link in robot.links() if len(link["ready"]) == 2)


def settled(robot: Robot, *replicas: Replica) -> None:
    """Wait until these replicas are ready and have applied the same, then compare their states."""
    slots = sorted(r.id.slot for r in replicas)
    wait_for(lambda: fully_ready(robot) == slots, f"replicas {slots} to be ready")
    wait_for(
        lambda: all(
            s["order"]["joined"] == len(slots) for s in robot.report().get("services", {}).values()
        ),
        "all to have joined",
    )
    wait_for(lambda: len({state_of(r) for r in replicas}) == 1, "equal states")


def test_kills_of_every_kind_leave_one_history_and_one_state(parts, clients):
    """The proxy, a `run`, the newest replica in its restore, all but one: one service is seen."""
    source = random.Random(1)
    first, second = parts.replica(0), parts.replica(1)
    robot = parts.robot("robot", first, second)
    counters = [
        clients(robot, "/count", lambda: (("add", 1), ("get", 0))[source.random() < 0.3])
        for _ in range(2)
    ]
    stores = [
        clients(
            robot,
            "/store",
            lambda: (
                ("put", source.choice("ab"), source.randint(0, 999))
                if source.random() < 0.6
                else ("get", source.choice("ab"))
            ),
        )
        for _ in range(2)
    ]

    def answered_more(count: int = by_day(12, at_night=30)) -> None:
        before = [c.answered for c in (*counters, *stores)]
        wait_for(
            lambda: all(
                c.answered >= b + count for c, b in zip((*counters, *stores), before, strict=True)
            ),
            "answers",
        )

    def patience(seconds: float) -> None:
        for client in (*counters, *stores):
            client.patience_s = seconds

    def restarted() -> tuple[float, float]:
        """Kill the sequencer; return when, and when all were answered again."""
        killed = time.monotonic()
        patience(GIVE_UP_KILLED_S)  # a proxy that was killed answers nothing
        robot.restart()
        answered_more()
        patience(GIVE_UP_S)
        return killed, time.monotonic()

    answered_more()
    os.kill(first.run_pid(), 9)  # its state is gone: it is restored
    answered_more()
    restarts = [restarted()]

    began = parts.folder / "restore-began"
    newest = parts.replica(2, f"2.0 {began}")  # its restore takes two seconds
    robot.follow(first, second, newest)
    wait_for(began.exists, "the newest replica's restore to begin")
    newest.process.kill()
    answered_more()

    third = parts.replica(3)
    robot.follow(first, second, third)
    wait_for(lambda: 3 in fully_ready(robot), "the third replica")
    first.process.kill()  # all but one, and that is not the one which began
    second.process.kill()
    answered_more()
    restarts.append(restarted())
    for client in (*counters, *stores):
        client.stop()
    first.start_again()
    robot.follow(first, third)
    settled(robot, first, third)
    count_history = [call for c in counters for call in c.history]
    store_history = [call for c in stores for call in c.history]
    assert linearizable(count_history, counter, 0)
    for key in "ab":  # each key is a service of its own: checked apart
        assert linearizable([c for c in store_history if c.asked[1] == key], key_value, ())
    total, values = state_of(third)
    assert b'"total": 0' not in total
    assert values != b"{}"
    # Only what a killed proxy had taken, or what was asked while there was none, is lost.
    lost = [
        call
        for client in (*counters, *stores)
        for call, given_up in zip(client.history, client.given_up(), strict=True)
        if not call.answered
        and not any(call.began <= back and killed <= given_up for killed, back in restarts)
    ]
    assert not lost, (lost, restarts)


def test_an_order_outlives_all_replicas_and_its_client_proxy(parts, clients):
    """Another robot cannot have it; every machine is lost; it is handed over under load."""
    old = parts.replica(0)
    robot = parts.robot("robot", old)
    counters = [clients(robot, "/count", lambda: ("add", 1)) for _ in range(3)]
    another_robot_is_refused(parts, old, counters[0])
    new = all_replicas_are_lost(parts, robot, old, counters)
    replicas = [new, parts.replica(2)]
    robot.follow(*replicas)
    wait_for(lambda: fully_ready(robot) == [1, 2], "both replicas")
    for client in counters:
        client.go_on()
    a_client_proxy_that_is_told_to_end_hands_its_order_over(robot, counters)
    settled(robot, *replicas)


def a_client_proxy_that_is_told_to_end_hands_its_order_over(robot, counters):
    """Twice under load: what the first took is not run again, what it left is taken up.

    On a busy machine a caller may find the next one too late for what it asks in that moment.
    """
    begun = [c.answered for c in counters]
    wait_for(
        lambda: all(c.answered >= n + 5 for c, n in zip(counters, begun, strict=True)), "answers"
    )
    moments = []
    for _ in range(2):
        leaving, robot.process = robot.process, robot.start_standby()
        began = time.monotonic()
        leaving.terminate()
        assert leaving.wait(LIMIT_S) == 0
        moments.append((began, time.monotonic()))
        wait_for(lambda: robot.report().get("pid") == robot.process.pid, "the standby's report")
        before = [c.answered for c in counters]
        wait_for(
            lambda b=before: all(c.answered > n for c, n in zip(counters, b, strict=True)),
            "answers of the standby",
        )
    for client in counters:
        client.stop()
    history = [call for client in counters for call in client.history]
    lost = [call for call in history if not call.answered]
    assert all(any(at <= call.began <= until for at, until in moments) for call in lost), lost
    assert len(lost) <= len(counters), "one of each caller, in the worst moment"
    assert linearizable(history, counter, 0)
    added = [call for call in history if call.asked[0] == "add"]
    assert len(added) - len(lost) <= counters[0].ask(("get", 0)) <= len(added)


def another_robot_is_refused(parts, replica, client):
    """Two robots cannot order against each other: the second says who has the service."""
    wait_for(lambda: client.answered >= 5, "answers")
    other = parts.robot("two", replica)

    def trouble() -> str:
        with contextlib.suppress(KeyError):
            return str(other.report()["services"]["/count"]["order"]["trouble"])
        return ""

    assert "`robot`" in wait_for(trouble, "the second robot to be told")
    before = client.answered
    wait_for(lambda: client.answered > before + 5, "the first robot to go on")
    other.process.kill()


def all_replicas_are_lost(parts, robot, old, counters):
    """The only machine is killed; the new one is given the state by the robot's proxy."""
    for client in counters:
        client.stop()
    old.process.kill()
    new = parts.replica(1)
    robot.follow(new)
    wait_for(lambda: fully_ready(robot) == [1], "the new replica")
    added = sum(client.answered for client in counters)
    assert counters[0].ask(("get", 0), LIMIT_S) == added
    assert linearizable([call for client in counters for call in client.history], counter, 0)
    return new
