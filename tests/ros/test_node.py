"""The take loop: what may go wrong around it, and that it lives on."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from fogft.errors import RosError
from fogft.ros import cyclone
from tests.needs import needs

from .conftest import LIMIT_S, SET_BOOL, expect_line, wait_for

pytestmark = pytest.mark.ros

TRUE = b"\x00\x01\x00\x00\x01"
RESPONSE = b"\x00\x01\x00\x00\x01\x00\x00\x00\x01\x00\x00\x00\x00"


def echo_pair(make_node: Callable[[int], Any], domain: int) -> tuple[Any, Any]:
    """Return a server that answers and a client that has found it, on two nodes."""
    server = make_node(domain).serve(
        "/flag", SET_BOOL, lambda _, handle: server.respond(handle, RESPONSE)
    )
    client = make_node(domain).client("/flag", SET_BOOL)
    wait_for(client.available, "discovery")
    return server, client


@needs("fastdds")
def test_no_other_user_can_read_what_a_node_sends(
    make_node: Callable[[int], Any], ros_domain: int
) -> None:
    """Fast DDS makes its segments readable by all; ports hold no message, and stay as they are."""
    echo_pair(make_node, ros_domain)
    maps = Path("/proc/self/maps").read_text()
    segments = set(re.findall(r"/dev/shm/fast(?:dds|rtps)_[0-9a-f]{16}$", maps, re.M))
    assert segments
    assert {Path(one).stat().st_mode & 0o777 for one in segments} == {0o600}


def test_a_first_node_ends_once_the_next_one_is_known(ros_domain: int) -> None:
    """If it ended at once, Fast DDS could tell those that run of the next one a second later."""
    from fogft.ros.joining import EarlyJoin, bare_node, new_context
    from fogft.ros.node import SerialisedNode

    watcher = bare_node("watcher", new_context(ros_domain))
    early = EarlyJoin("_first", ros_domain)
    with closing(SerialisedNode("next", ros_domain, early=early)) as node:
        node.look()
        wait_for(lambda: {"_first", "next"} <= set(watcher.get_node_names()), "discovery")
        wait_for(lambda: (node.look(), "_first" not in watcher.get_node_names())[1], "its end")
        assert "next" in watcher.get_node_names()
    early = EarlyJoin("_first", ros_domain)
    with closing(SerialisedNode("next", ros_domain, early=early)):
        wait_for(lambda: {"_first", "next"} <= set(watcher.get_node_names()), "discovery")
    wait_for(lambda: watcher.get_node_names() == ["watcher"], "their end, before `early` goes")
    watcher.context.try_shutdown()


def test_a_requests_handle_tells_whose_client_asked(ros_domain: int) -> None:
    """Whatever the middleware's handles are made of; of two clients, each has its own node."""
    from fogft.ros.node import SerialisedNode

    handles: list[bytes] = []
    with (
        closing(SerialisedNode("offers", ros_domain)) as offers,
        closing(SerialisedNode("one", ros_domain)) as one,
        closing(SerialisedNode("two", ros_domain)) as two,
    ):
        offers.serve("/flag", SET_BOOL, lambda _, handle: handles.append(handle))
        for n, (name, node) in enumerate({"one": one, "two": two}.items()):
            node.serve(f"/{name}/turn", SET_BOOL, lambda _, handle: None)
            client = node.client("/flag", SET_BOOL)
            wait_for(client.available, "discovery")
            client.call(TRUE, lambda _: None)
            wait_for(lambda n=n: len(handles) > n, "the request")
        for name, handle in zip(("one", "two"), handles, strict=True):
            wait_for(
                lambda handle=handle, name=name: (
                    offers.same_node_serves("turn", "/flag", handle[:16]) == f"/{name}/turn"
                ),
                name,
            )
            assert offers.same_node_serves("turns", "/flag", handle[:16]) == ""
        assert offers.same_node_serves("turn", "/flag", bytes(16)) is None


TELLS = """
import sys
from time import sleep
from fogft.ros.node import SerialisedNode
node = SerialisedNode("standby", int(sys.argv[1]))
node.serve("/flag", "std_srvs/srv/SetBool",
           lambda _, handle: print(node.identity(handle).hex(), flush=True))
while not node.callers("/flag"): sleep(0.01)
print("knows the caller", flush=True)
sys.stdin.read()
node.close()
"""


def test_two_processes_tell_a_request_by_the_same(ros_domain: int) -> None:
    """As a client proxy and the one that takes over do, or each would have it run."""
    from fogft.ros.node import SerialisedNode

    told: list[str] = []
    with (
        subprocess.Popen(
            [sys.executable, "-c", TELLS, str(ros_domain)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        ) as standby,
        closing(SerialisedNode("leaving", ros_domain)) as leaving,
        closing(SerialisedNode("asks", ros_domain)) as asks,
    ):  # fmt: skip
        assert standby.stdin is not None
        assert standby.stdout is not None
        leaving.serve(
            "/flag", SET_BOOL, lambda _, handle: told.append(leaving.identity(handle).hex())
        )
        client = asks.client("/flag", SET_BOOL)
        wait_for(lambda: client.servers() == 2, "discovery")
        assert standby.stdout.readline() == "knows the caller\n"
        for n in range(3):
            client.call(TRUE, lambda _: None)
            wait_for(lambda n=n: len(told) > n, "the request")
        theirs = [standby.stdout.readline().strip() for _ in told]
        standby.stdin.close()
    assert theirs == told
    assert len(set(told)) == 3


def test_no_writer_is_known_where_cyclone_dds_is_not_loaded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nor is it loaded: in a process with another DDS it would be a second one."""
    monkeypatch.setattr(cyclone, "LIBRARY", "libddsc.so.none")
    cyclone.loaded_library.cache_clear()
    try:
        assert cyclone.writer_of(bytes(16), 0) == b""
    finally:
        cyclone.loaded_library.cache_clear()


def test_a_node_never_takes_another_of_its_name_for_itself(ros_domain: int) -> None:
    """While both offer a service, as when one hands over to the other, neither tells its id."""
    from fogft.ros.node import SerialisedNode

    with closing(SerialisedNode("ours", ros_domain)) as second:
        with closing(SerialisedNode("ours", ros_domain)) as first:
            first.serve("/flag", SET_BOOL, lambda payload, handle: None)
            wait_for(lambda: bool(first.participant("/flag")), "its own id")
            own = first.participant("/flag")
            second.serve("/flag", SET_BOOL, lambda payload, handle: None)
            wait_for(lambda: not first.participant("/flag"), "the other one")
            assert second.participant("/flag") != own
        wait_for(lambda: bool(second.participant("/flag")), "the first one's end")
        assert second.participant("/flag") != own


def test_a_callback_that_raises_costs_only_its_own_message(
    make_node: Callable[[int], Any], ros_domain: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Errors of callbacks are logged, on both sides; the next message is served."""
    seen: list[bytes] = []

    def on_request(payload: bytes, handle: Any) -> None:
        seen.append(payload)
        if len(seen) == 1:
            raise ValueError("first request")
        server.respond(handle, RESPONSE)

    def fail(_: bytes) -> None:
        raise ValueError("first response")

    server = make_node(ros_domain).serve("/flag", SET_BOOL, on_request)
    client = make_node(ros_domain).client("/flag", SET_BOOL)
    wait_for(client.available, "discovery")
    answers: list[bytes] = []
    client.call(TRUE, answers.append)
    client.call(TRUE, fail)
    client.call(TRUE, answers.append)
    wait_for(lambda: answers, "the third response")
    assert caplog.text.count("ValueError: first") == 2


def test_bytes_of_another_type_are_refused_or_read_never_fatal(
    make_node: Callable[[int], Any], ros_domain: int
) -> None:
    """Noise to call and to respond ends in an error, and both loops live on."""
    server, client = echo_pair(make_node, ros_domain)
    for noise in (b"\xff" * 3, b"\xff" * 4, b"\xff" * 64, b"\x00\x01\x00\x00", b""):
        with pytest.raises(RosError, match="not a serialised SetBool_Request"):
            client.call(noise, lambda _: None)
        with pytest.raises(RosError, match="not a serialised SetBool_Response"):
            server.respond(bytes(24), noise)
    answers: list[bytes] = []
    client.call(TRUE, answers.append)
    wait_for(lambda: answers, "a response after the noise")
    assert answers[0][4] == 1


def test_a_wrong_service_name_is_an_error(make_node: Callable[[int], Any], ros_domain: int) -> None:
    """A name that ROS refuses is said, and the node lives on."""
    node = make_node(ros_domain)
    for name in ("no spaces", "", "/trailing/"):
        with pytest.raises(RosError, match="cannot be created"):
            node.serve(name, SET_BOOL, lambda *_: None)
        with pytest.raises(RosError, match="cannot be created"):
            node.client(name, SET_BOOL)
    assert node.alive


def test_a_wrong_node_name_is_an_error() -> None:
    """A node name that ROS refuses is an error of ours, not a trace of rclpy's."""
    from fogft.ros.node import SerialisedNode

    with pytest.raises(RosError, match="`not a name`"):
        SerialisedNode("not a name")


def test_closing_from_callbacks(make_node: Callable[[int], Any], ros_domain: int) -> None:
    """A callback may close its service, its client, even the node: nothing waits for itself."""
    server_node, client_node = make_node(ros_domain), make_node(ros_domain)

    def on_request(_: bytes, handle: Any) -> None:
        server.respond(handle, RESPONSE)
        server.close()

    def on_response(_: bytes) -> None:
        client.close()
        client_node.close()

    server = server_node.serve("/flag", SET_BOOL, on_request)
    client = client_node.client("/flag", SET_BOOL)
    wait_for(client.available, "discovery")
    client.call(TRUE, on_response)
    wait_for(lambda: not client_node.alive, "the client's node to end")
    watcher = server_node.client("/flag", SET_BOOL)
    wait_for(lambda: not watcher.available(), "the service to be gone")
    assert server_node.alive


def test_services_come_and_go_under_traffic(
    make_node: Callable[[int], Any], ros_domain: int
) -> None:
    """Entities made and closed by other threads cost no message of one that stays."""
    _, client = echo_pair(make_node, ros_domain)
    node = make_node(ros_domain)
    errors: list[BaseException] = []

    def come_and_go(number: int) -> None:
        try:
            for turn in range(10):
                made = [
                    node.serve(f"/s{number}_{turn}", SET_BOOL, lambda *_: None),
                    node.client(f"/s{number}_{turn}", SET_BOOL),
                ]
                for entity in made:
                    entity.close()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=come_and_go, args=(number,)) for number in range(3)]
    for thread in threads:
        thread.start()
    answers: list[bytes] = []
    sent: list[int] = []
    while len(sent) < 200 or any(thread.is_alive() for thread in threads):
        sent.append(client.call(TRUE, answers.append))
        wait_for(lambda: len(sent) - len(answers) < 20, "room in flight")
    for thread in threads:
        thread.join(LIMIT_S)
    wait_for(lambda: len(answers) == len(sent), "every response")
    assert errors == []


CHILD = """
import os, signal, sys, threading
from fogft.ros.node import SerialisedNode
before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
node = SerialisedNode("child")
node.serve("/here", "std_srvs/srv/SetBool", lambda *_: None)
client = node.client("/here", "std_srvs/srv/SetBool")
while not client.available(): pass
assert before == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))
node.close()
assert threading.enumerate() == [threading.main_thread()], threading.enumerate()
"""


def test_a_node_leaves_the_process_as_it_was(ros_domain: int, tmp_path: Path) -> None:
    """No signal handler, no thread, no file in the home folder; the domain is the variable's."""
    environ = {**os.environ, "HOME": str(tmp_path), "ROS_DOMAIN_ID": str(ros_domain)}
    environ.pop("ROS_LOG_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", CHILD], env=environ, timeout=100, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_process_that_forgets_to_close_still_ends(ros_domain: int) -> None:
    """An interrupted process ends: the take loop holds nobody back."""
    child = (
        "import time; from fogft.ros.node import SerialisedNode\n"
        f"node = SerialisedNode('child', {ros_domain}); print('up', flush=True)\n"
        "while True: time.sleep(0.1)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", child], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    expect_line(process, "up")
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode != 0
    assert "KeyboardInterrupt" in errors
