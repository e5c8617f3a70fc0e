"""Sweeping /dev/shm: what goes, and above all what stays."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import mmap
import os
import secrets
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest

from fogft.ros import shared_memory, spdp
from tests.needs import needs

from .conftest import LIMIT_S, SET_BOOL, expect_line, wait_for


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of shared memory apart from the machine's own, where files count at once."""
    with tempfile.TemporaryDirectory(dir=shared_memory.FOLDER, prefix="fogft-test-") as name:
        monkeypatch.setattr(shared_memory, "FOLDER", Path(name))
        monkeypatch.setattr(shared_memory, "SETTLED_S", 0.0)
        yield Path(name)


@pytest.fixture
def leave(folder: Path) -> Callable[[str], Path]:
    """Leave files as a killed process would."""

    def leave_file(name: str) -> Path:
        (folder / name).write_bytes(b"left")
        return folder / name

    return leave_file


LEFT = {  # each a group of its own
    "fastdds_0123456789abcdef",
    "fastdds_1123456789abcdef_el",
    "fastrtps_2123456789abcdef",
    "fastrtps_3123456789abcdef_el",
    "fastdds_port7411",
    "fastdds_port7412_el",
    "fastdds_port7413_sl",
    "sem.fastdds_port7414_mutex",
    "sem.fastrtps_port7415_mutex",
    "fast_datasharing_01.0f.bd_0.0.1.3",
    "lttng-ust-wait-6-0",
}
OTHERS = {"psm_1", "sem.other", "fastdds_12_x", "fastdds_xyz", "my_fastdds_12", "lttng"}


def test_what_nobody_uses_goes_and_what_is_not_ros_stays(
    folder: Path, leave: Callable[[str], Path]
) -> None:
    for name in LEFT | OTHERS:
        leave(name)
    assert set(shared_memory.sweep()) == LEFT
    assert set(os.listdir(folder)) == OTHERS


@pytest.mark.parametrize("used", ["fastdds_ab", "fastdds_ab_el"])
def test_an_open_file_keeps_its_group(leave: Callable[[str], Path], used: str) -> None:
    """One file in use keeps all that belong to it."""
    paths = [leave("fastdds_ab"), leave("fastdds_ab_el")]
    with leave(used).open("rb"):
        shared_memory.sweep()
        assert all(path.exists() for path in paths)
    shared_memory.sweep()
    assert not any(path.exists() for path in paths)


def test_a_mapped_file_stays(leave: Callable[[str], Path]) -> None:
    """A mapping counts though the file is closed, as Fast DDS does it."""
    path = leave("fastdds_ab")
    libc = ctypes.CDLL(None)  # Python's own mmap keeps the file open
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long)
    descriptor = os.open(path, os.O_RDONLY)
    mapped = libc.mmap(None, 4, mmap.PROT_READ, mmap.MAP_SHARED, descriptor, 0)
    os.close(descriptor)
    shared_memory.sweep()
    assert path.exists()
    libc.munmap(ctypes.c_void_p(mapped), ctypes.c_size_t(4))
    assert path.name in shared_memory.sweep()


def test_a_locked_file_stays_though_its_holder_is_hidden(
    leave: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lock tells of a process in another container, which /proc does not show."""
    monkeypatch.setattr(shared_memory, "names_in_use", set)
    path, lock = leave("fastdds_ab"), leave("fastdds_ab_el")
    with lock.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_SH)
        shared_memory.sweep()
        assert path.exists()
    assert {path.name, lock.name} <= set(shared_memory.sweep())


def test_a_fresh_file_stays(leave: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Between making a file and mapping it there is a moment; a whole group waits for it."""
    monkeypatch.setattr(shared_memory, "SETTLED_S", 3600.0)
    path = leave("fastdds_ab")
    shared_memory.sweep()
    assert path.exists()


def test_files_of_others_stay(
    leave: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = leave("fastdds_ab")
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    shared_memory.sweep()
    assert path.exists()


def test_a_file_that_comes_into_use_while_sweeping_stays(
    leave: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second look counts."""
    path = leave("fastdds_ab")
    looks = iter([set[str](), {path.name}])
    monkeypatch.setattr(shared_memory, "names_in_use", lambda: next(looks))
    assert path.name not in shared_memory.sweep()
    assert path.exists()


def test_a_port_is_judged_under_its_mutex(
    leave: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody can open a port between the second look and its end; then the mutex is free again."""
    steps: list[str] = []
    used_names, unlink = shared_memory.names_in_use, shared_memory.unlink_name
    monkeypatch.setattr(
        shared_memory, "names_in_use", lambda: (steps.append("look"), used_names())[1]
    )
    monkeypatch.setattr(
        shared_memory, "unlink_name", lambda name: (steps.append(name), unlink(name))[1]
    )
    monkeypatch.setattr(
        shared_memory, "semaphore", lambda group, what: steps.append(f"{group} {what}") or True
    )
    leave("fastdds_port7411")
    leave("sem.fastdds_port7411_mutex")
    shared_memory.sweep()
    assert steps == [
        "look",
        "fastdds_port7411 sem_trywait",
        "look",
        "fastdds_port7411",
        "look",
        "fastdds_port7411_aside sem_post",
        "sem.fastdds_port7411_aside_mutex",
    ]


def test_a_mutex_that_somebody_waits_for_meanwhile_stays(
    leave: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next one to open the port would not wait for the one that waits."""
    leave("fastdds_port7411")
    mutex = leave("sem.fastdds_port7411_mutex")
    looks = iter([set[str](), set[str](), {"sem.fastdds_port7411_aside_mutex"}])
    monkeypatch.setattr(shared_memory, "names_in_use", lambda: next(looks))
    assert shared_memory.sweep() == ["fastdds_port7411"]
    assert os.listdir(mutex.parent) == [mutex.name]
    assert mutex.read_bytes() == b"left"


@pytest.mark.parametrize("left", ["_aside", "_aside_aside"])
def test_a_mutex_that_a_killed_sweep_left_goes(leave: Callable[[str], Path], left: str) -> None:
    mutex = leave(f"sem.fastdds_port7411{left}_mutex")
    assert shared_memory.sweep() == [mutex.name]
    assert os.listdir(mutex.parent) == []


def test_a_mutex_that_somebody_makes_meanwhile_is_not_posted(
    leave: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would let two at once to the port from then on."""
    posted: list[str] = []
    monkeypatch.setattr(
        shared_memory, "semaphore", lambda group, what: posted.append(group + what) or True
    )
    leave("fastdds_port7411")
    mutex = leave("sem.fastdds_port7411_mutex")
    looks = iter([list, list, lambda: mutex.write_bytes(b"another")])
    monkeypatch.setattr(shared_memory, "names_in_use", lambda: (next(looks)(), set[str]())[1])
    shared_memory.sweep()
    assert mutex.read_bytes() == b"another"
    assert "fastdds_port7411sem_post" not in posted


def test_a_mutex_is_had_once_and_leaves_no_mapping() -> None:
    """It is the semaphore that Fast DDS knows by this name; holding it does not look like use."""
    group = f"fogft_test_{secrets.token_hex(6)}"
    libc = ctypes.CDLL(None)
    libc.sem_open.restype = ctypes.c_void_p
    made = libc.sem_open(f"/{group}_mutex".encode(), os.O_CREAT, 0o600, 1)
    assert made
    libc.sem_close(ctypes.c_void_p(made))
    try:
        assert shared_memory.semaphore(group, "sem_trywait")
        assert not shared_memory.semaphore(group, "sem_trywait")
        assert group not in Path("/proc/self/maps").read_text()
        assert shared_memory.semaphore(group, "sem_post")
        assert shared_memory.semaphore(group, "sem_trywait")
    finally:
        Path(f"/dev/shm/sem.{group}_mutex").unlink()
    assert not shared_memory.semaphore(group, "sem_trywait")


def test_sweeps_side_by_side_remove_each_file_once(leave: Callable[[str], Path]) -> None:
    paths = [leave(f"fastdds_{number:04x}") for number in range(50)]
    removed: list[str] = []
    threads = [
        threading.Thread(target=lambda: removed.extend(shared_memory.sweep())) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LIMIT_S)
    names = {path.name for path in paths}
    assert sorted(name for name in removed if name in names) == sorted(names)


def test_sweeping_does_not_load_ros() -> None:
    """`fogft down` sweeps; it must not start ROS for that."""
    code = "import sys; from fogft.ros import shared_memory; shared_memory.sweep()\n"
    code += "assert not {'rclpy', 'zenoh'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)


NODE = """
import signal, sys
from fogft.ros.node import SerialisedNode
node = SerialisedNode("left", int(sys.argv[1]))
server = node.serve("/left", "std_srvs/srv/SetBool", lambda _, h: server.respond(h, ANSWER))
ANSWER = bytes([0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0])
print("up", flush=True)
signal.pause()
"""


@pytest.mark.ros
@needs("fastdds")
def test_a_live_node_survives_and_a_killed_one_is_swept(
    make_node: Callable[[int], Any], ros_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sweeping under a live pair costs nothing; after SIGKILL nothing of the dead one is left."""
    process = _other_node(ros_domain)
    try:
        theirs = _names_of(process.pid)
        assert theirs
        _judge_only(theirs, monkeypatch)
        client = make_node(ros_domain).client("/left", SET_BOOL)
        wait_for(client.available, "discovery")
        answers: list[bytes] = []
        for _ in range(2):
            assert not theirs & set(shared_memory.sweep())
            client.call(b"\x00\x01\x00\x00\x01", answers.append)
        wait_for(lambda: len(answers) == 2, "responses while sweeping")
    finally:
        process.kill()
        process.wait()

    def left() -> set[str]:
        shared_memory.sweep()
        return theirs & set(os.listdir(shared_memory.FOLDER)) - shared_memory.names_in_use()

    wait_for(lambda: not left(), "nothing left")  # our node may let go of a port just after a sweep
    assert theirs - _names_of(os.getpid())


def test_ports_are_looked_at_when_one_goes_and_not_for_the_files_beside_it(
    leave: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those beside it, and other domains' ports, go with each ROS process of the machine."""
    looks: SimpleQueue[None] = SimpleQueue()

    def look() -> tuple[set[int], int]:
        looks.put(None)
        return set(), 0

    monkeypatch.setattr(shared_memory, "reopen_ports", look)
    names = ("port7661", "port7399", "port7411_el", "port7411_sl", "port7411")
    left = [leave(f"fastdds_{name}") for name in names]
    watch = shared_memory.PortWatch(0)
    looks.get(timeout=LIMIT_S)
    for path in left:
        path.unlink()
    looks.get(timeout=LIMIT_S)
    watch.close()
    assert looks.empty()


def _other_node(domain: int, program: str = NODE) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(domain)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    expect_line(process, "up")
    return process


@pytest.mark.ros
@needs("fastdds")
def test_the_ports_of_killed_processes_are_broken_and_others_not(
    ros_domain: int, request: pytest.FixtureRequest
) -> None:
    """A client of the killed one would write to its memory when a new one has its number."""
    first = spdp.first_port(ros_domain)
    process = _other_node(ros_domain)
    ports = _ports_of(process.pid, first)
    alive = shared_memory.break_dead_ports(ros_domain)
    process.kill()
    process.wait()
    assert ports
    assert not ports & alive
    planted = shared_memory.FOLDER / f"{min(ports)}_el"
    planted.unlink(missing_ok=True)
    os.mkfifo(planted)  # opening it would wait for a writer
    request.addfinalizer(lambda: planted.unlink(missing_ok=True))
    assert ports <= shared_memory.break_dead_ports(ros_domain)
    assert not ports & shared_memory.break_dead_ports(ros_domain)


@pytest.mark.ros
@needs("fastdds")
def test_the_ports_of_other_users_are_let_be(
    ros_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = _other_node(ros_domain)
    process.kill()
    process.wait()
    with monkeypatch.context() as other:
        other.setattr(os, "getuid", lambda: 12345)
        assert not shared_memory.break_dead_ports(ros_domain)
    assert shared_memory.break_dead_ports(ros_domain)


@pytest.mark.ros
@needs("fastdds")
def test_what_fast_dds_complains_of_is_no_part_of_the_output(ros_domain: int) -> None:
    """A program prints its data there. It complains of a port that somebody has, without its file.

    Two that open and end a port at once can leave one so: Fast DDS removes the lock between them.
    """
    first = spdp.first_port(ros_domain) + 1
    with contextlib.ExitStack() as held:
        for number in range(first, first + 20, 2):
            for begin in ("fastdds", "fastrtps"):
                port = shared_memory.FOLDER / f"{begin}_port{number}"
                port.unlink(missing_ok=True)  # it may be left by another test
                lock = port.with_name(f"{port.name}_el")
                held.callback(lock.unlink, missing_ok=True)
                fcntl.flock(held.enter_context(lock.open("w")), fcntl.LOCK_EX)
        process = _other_node(ros_domain)
    process.kill()
    assert "Failed init_port" in process.communicate()[1]


def _ports_of(pid: int, first: int) -> set[str]:
    names = {
        f"{begin}_port{number}"
        for begin in ("fastdds", "fastrtps")
        for number in range(first, first + 240)
    }
    return _names_of(pid) & names


ORDINARY = """
import sys, rclpy
from std_srvs.srv import SetBool
rclpy.init(domain_id=int(sys.argv[1]))
node = rclpy.create_node("left")
node.create_service(SetBool, "/left", lambda _, response: response)
print("up", flush=True)
rclpy.spin(node)
"""

CALLER = """
import sys, rclpy
from fogft.ros import shared_memory
from std_srvs.srv import SetBool
rclpy.init()
node = rclpy.create_node("caller")
client = node.create_client(SetBool, "/left")
client.wait_for_service()
rclpy.spin_until_future_complete(node, client.call_async(SetBool.Request(data=True)))
for asked in sys.stdin:
    while not (found := shared_memory.reopen_ports()[1]) and asked == "until found\\n":
        pass
    print(found, flush=True)
"""


@pytest.mark.ros
@needs("fastdds")
def test_a_port_that_a_successor_removed_is_known_by_its_bytes(ros_domain: int) -> None:
    """They are Fast DDS's own: nothing of them is documented.

    Now and then Fast DDS finds out first, when it writes just after the port's owner was killed.
    """
    environ = {**os.environ, "ROS_DOMAIN_ID": str(ros_domain)}
    command, pipe = [sys.executable, "-c", CALLER], subprocess.PIPE
    killed = _other_node(ros_domain, ORDINARY)
    caller = subprocess.Popen(command, env=environ, stdin=pipe, stdout=pipe, text=True)
    threads = ThreadPoolExecutor(1)
    try:
        assert _broken(caller) == 0
        found = threads.submit(_broken, caller, "until found")
        while not found.done():
            killed.kill()
            killed.wait()
            killed = _other_node(ros_domain, ORDINARY)
            wait([found], 0.5)
        assert found.result() > 0
    finally:
        for process in (killed, caller):
            process.kill()
            process.wait()
        threads.shutdown()


def _broken(process: subprocess.Popen[str], asked: str = "now") -> int:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(f"{asked}\n")
    process.stdin.flush()
    return int(process.stdout.readline())


def _judge_only(names: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge these files at once, and leave alone the fresh ones of whoever else runs here."""
    groups = shared_memory.grouped_names
    monkeypatch.setattr(shared_memory, "SETTLED_S", 0.0)
    monkeypatch.setattr(
        shared_memory,
        "grouped_names",
        lambda: {group: found for group, found in groups().items() if names & set(found)},
    )


def _names_of(pid: int) -> set[str]:
    """Return the Fast DDS files that a process maps."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    segments = ("/dev/shm/fastdds_", "/dev/shm/fastrtps_")  # since Fast DDS 3, and before
    return {line.rsplit("/", 1)[1] for line in lines if any(name in line for name in segments)}
