"""What every test may use: ROS domains of its own, and discovery that stays on this machine."""

from __future__ import annotations

import fcntl
import gc
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest

from fogft.ros import shared_memory
from tests import own_process
from tests.dealing import dealt
from tests.link.namespaces import Namespaces
from tests.needs import must_run, need, not_run
from tests.nightly import NIGHTLY, by_day
from tests.rmw_zenoh.rmw_router import Router, running

# No test asserts wall-clock time; Hypothesis would, by default.
# In CI the same examples each time: a new one is found by a person, who can look at it.
hypothesis.settings.register_profile(
    "fogft",
    deadline=None,
    max_examples=by_day(40, at_night=400),
    derandomize=bool(os.environ.get("CI")) and not NIGHTLY,
)
hypothesis.settings.load_profile("fogft")

# Set before any test imports rclpy; child processes inherit it.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

# numpy's OpenBLAS starts a thread in each process that loads it, which spins before it sleeps.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The tests start some thousand processes: half of what each costs is compiling the package anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# `pyzeros` makes a folder for what it compiles where it is imported, else in the working folder.
os.environ.setdefault("CYDR_CACHE_DIR", f"{tempfile.gettempdir()}/fogft-test-cydr-{os.getuid()}")

# A shell's background job ignores Ctrl-C, and so would every process that a test interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

TESTS = Path(__file__).parent
DOMAINS = range(60, 101)  # above 101 the ports of a domain reach Linux's ephemeral ones

# Folders of tests that start no process, open no connection and wait for nothing.
COMPUTING = {
    "docs",
    "evaluation",
    "examples",
    "fuzz",
    "model",
    "ordering",
    "planning",
    "poolfile",
    "requests",
    "simulation",
    "topics",
}

# About how long one test takes, in files whose tests take long: see `dealing`.
TAKES_S = {
    "e2e/test_connectivity.py": 25,
    "e2e/test_discovery.py": 20,
    "e2e/test_inspection.py": 25,
    "e2e/test_keys_and_moving.py": 50,
    "e2e/test_monitoring.py": 15,
    "e2e/test_own_types.py": 20,
    "e2e/test_pool.py": 40,
    "e2e/test_quickstart_page.py": 60,
    "e2e/test_rolling_update.py": 50,
    "hostile/test_flood.py": 5,
    "hostile/test_greedy.py": 5,
    "hostile/test_pool.py": 50,
    "hostile/test_replica.py": 15,
    "link/zenoh/robot/test_thin_downlink.py": 12,
    "link/zenoh/robot/test_thin_links.py": 15,
    "link/zenoh/test_hostile.py": 4,
    "proxy/test_broken_machine.py": 18,
    "proxy/test_connectivity.py": 10,
    "proxy/test_processes.py": 30,
    "proxy/test_sharing_processes.py": 10,
    "proxy/test_stateful_processes.py": 30,
    "proxy/test_topics_processes.py": 8,
    "ros/test_discovery_settings.py": 4,
    "ros/test_plain_clients.py": 5,
}


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Look for no garbage among some thousand tests, neither while they are made nor later."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Among several workers, let the long tests begin first: see `dealing`."""

    def limit_s(item: pytest.Item) -> float:
        marker = item.get_closest_marker("timeout")
        return float(marker.args[0]) if marker and marker.args else 0.0

    def takes_s(item: pytest.Item) -> float:
        return TAKES_S.get(item.path.relative_to(TESTS).as_posix(), 0.0)

    def computes(item: pytest.Item) -> bool:
        return item.path.relative_to(TESTS).parts[0] in COMPUTING

    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        items[:] = dealt(items, limit_s, takes_s, computes, workers)


def pytest_configure() -> None:
    """Refuse a misspelt `FOGFT_MUST_RUN` before anything runs."""
    must_run()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave a test out, before its fixtures are made, where something that it needs is missing."""
    for marker in item.iter_markers("needs"):
        need(*marker.args, whole_file=False)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Close with what was not run, and why."""
    for line in not_run(terminalreporter.stats.get("skipped", [])):
        terminalreporter.write_line(line, yellow=True)


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove the shared memory that killed ROS processes left, once all workers have ended."""
    if not hasattr(config, "workerinput"):
        shared_memory.sweep()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is marked so in a process of its own."""
    return own_process.run(pyfuncitem) or None


def lock_domain(taken: dict[int, int]) -> int:
    """Lock a free domain id against this user's other test runs; its descriptor goes to `taken`."""
    folder = Path(tempfile.gettempdir()) / f"fogft-test-domains-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    start = os.getpid() % len(DOMAINS)
    for domain in (*DOMAINS[start:], *DOMAINS[:start]):
        descriptor = os.open(folder / str(domain), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            continue
        taken[domain] = descriptor
        return domain
    pytest.fail("no ROS domain is free: do other test runs hang?")


@pytest.fixture
def ros_domains() -> Iterator[Callable[[], int]]:
    """Hand out ROS domain ids that no other test has, until this test ends."""
    taken: dict[int, int] = {}
    yield lambda: lock_domain(taken)
    for descriptor in taken.values():
        os.close(descriptor)


@pytest.fixture
def ros_domain(ros_domains: Callable[[], int]) -> int:
    """Return a ROS domain id that no other test has, until this test ends."""
    return ros_domains()


@pytest.fixture
def rmw_router() -> Iterator[Router]:
    """A Zenoh router, by which nodes of `rmw_zenoh` find each other."""
    with running() as router:
        yield router


@pytest.fixture
def net() -> Iterator[Namespaces]:
    """Network namespaces of the test's own."""
    need("namespaces", whole_file=False)
    made = Namespaces()
    try:
        yield made
    finally:
        made.close()
