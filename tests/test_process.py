"""Another process hangs when its main thread never comes round, whatever the disk says."""

from __future__ import annotations

import gc
import itertools
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fogft.child import python
from fogft.process import Hanging, begin_start, end_start, load_numpy
from tests.fakes.waiting import let_come_round, paced, wait_for
from tests.link.freezing import freeze
from tests.needs import needs

LIMIT_S = 10.0


class Looks:
    """Looks a second of its own clock apart."""

    def __init__(self) -> None:
        self.now = 0.0
        self.hanging = Hanging(LIMIT_S, lambda: self.now)

    def found_after(
        self, pid: int | None, limit: int | None = None, step_s: float = 1.0
    ) -> int | None:
        """Return how many looks it took to see it hang; None where so many did not show it."""
        for count in itertools.islice(paced(0.03), limit):
            if self.hanging.look(pid):
                return count
            self.now += step_s
        return None


@pytest.fixture
def start() -> Iterator[object]:
    started: list[subprocess.Popen[bytes]] = []

    def begin(code: str) -> int:
        process = subprocess.Popen([sys.executable, "-uc", f"print(1)\n{code}"], stdout=-1)
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline()
        return process.pid

    yield begin
    for process in started:
        process.kill()
        process.wait()


COMES_ROUND = "import time\nwhile True: time.sleep(0.005)"


@pytest.mark.parametrize(
    "code",
    [
        "while True: pass",
        "import threading; threading.Event().wait()",
        "import threading, time\n"
        "threading.Thread(target=lambda: [time.sleep(0.005) for _ in range(10**6)]).start()\n"
        "threading.Lock().acquire() and threading.Event().wait()",
    ],
)
def test_one_whose_main_thread_never_comes_round_hangs(start, code):
    assert Looks().found_after(start(code)) > LIMIT_S


def test_one_that_comes_round_does_not_hang_and_a_stopped_one_does(start):
    looks, pid = Looks(), start(COMES_ROUND)
    for _ in range(20):
        let_come_round(pid)
        assert looks.found_after(pid, limit=1) is None
    freeze(pid)
    assert looks.found_after(pid) > 0
    os.kill(pid, signal.SIGCONT)
    wait_for(lambda: not looks.hanging.look(pid), 60.0, "a turn of its")
    assert looks.found_after(pid, limit=5) is None


def test_a_pause_of_our_own_is_not_held_against_it(start):
    """A suspend of minutes stops both, and we may be the first to wake."""
    looks, pid = Looks(), start(COMES_ROUND)
    freeze(pid)
    assert looks.found_after(pid, limit=3, step_s=600.0) is None


def test_who_is_not_there_or_has_just_come_does_not_hang(start):
    looks = Looks()
    assert looks.found_after(None, limit=20) is None
    assert looks.found_after(2**22 + 1, limit=20) is None
    for _ in range(3):
        pid = start("import threading; threading.Event().wait()")
        assert looks.found_after(pid, limit=8) is None


def test_the_kernel_counts_here():
    assert "voluntary_ctxt_switches" in Path("/proc/self/status").read_text()


_LOADED = """
import json, os, sys
from fogft.process import load_numpy
load_numpy()
import numpy

threads = len(os.listdir("/proc/self/task"))
print(json.dumps({"threads": threads, "said": os.environ.get("OPENBLAS_NUM_THREADS")}))
"""


_WAITS = """
import signal
from fogft.process import Wakeup

woken = Wakeup()
told = 0

def tell(*_):
    global told
    told += 1
    woken.wake()

signal.signal(signal.SIGALRM, tell)
signal.setitimer(signal.ITIMER_REAL, 5e-4, 5e-4)
for _ in range(1500):
    woken.wait(0.001)
signal.setitimer(signal.ITIMER_REAL, 0)
woken.wait(0)
woken.wake()
woken.wake()
woken.wait(60)
print("ended", told > 0)
"""


def test_a_wait_may_be_ended_by_signals_at_any_point_of_it():
    """An Event's would hang for good: the handler waits for a lock of whom it interrupts."""
    ended = subprocess.run([sys.executable, "-c", _WAITS], stdout=-1, timeout=60, check=True)
    assert ended.stdout == b"ended True\n"


def loaded(**environ: str) -> dict:
    said = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"} | environ
    ended = subprocess.run([sys.executable, "-c", _LOADED], env=said, stdout=-1, check=True)
    return json.loads(ended.stdout)


@needs("numpy")
def test_numpy_starts_no_thread_and_others_may_have_theirs():
    assert loaded() == {"threads": 1, "said": None}


@needs("numpy", "cores")
def test_what_the_user_says_stays():
    assert loaded(OPENBLAS_NUM_THREADS="2") == {"threads": 2, "said": "2"}


def test_no_numpy_is_no_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "numpy", None)
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    load_numpy()
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_what_a_start_made_is_not_looked_through_again():
    before = gc.get_freeze_count()
    try:
        begin_start()
        assert not gc.isenabled()
        made = [[] for _ in range(1000)]
        end_start()
        assert gc.isenabled()
        assert gc.get_freeze_count() >= before + len(made)
        assert not any(one is made[0] for one in gc.get_objects())
    finally:
        gc.unfreeze()
        gc.enable()


_SURVIVES = """
import os, signal
from fogft.process import stop_on_signal

stop = stop_on_signal()
os.kill(os.getpid(), signal.SIGHUP)
print(stop.is_set())
os.kill(os.getpid(), signal.SIGTERM)
print(stop.is_set())
"""


@pytest.mark.parametrize("nohup", [False, True])
def test_a_closed_terminal_ends_a_process_except_under_nohup(nohup: bool) -> None:
    words = [*(["nohup"] if nohup else []), sys.executable, "-c", _SURVIVES]
    words = ["env", "--default-signal=HUP", *words]  # a `down` in this process ignores it
    ended = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    assert ended.stdout.split() == [str(not nohup), "True"]


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 imports from there first")
def test_our_processes_import_nothing_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is the pool file's: a `queue.py` can lie there."""
    (tmp_path / "queue.py").write_text("raise SystemExit('not this one')\n")
    monkeypatch.setattr(sys, "path", ["/opt/bin", *sys.path])
    ended = subprocess.run(
        python("-m", "queue"), cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")
