"""Zenoh gets one worker, unless the user says otherwise, and other programs do not."""

from __future__ import annotations

import json
import subprocess
import sys

from fogft.wire import runtime


def test_our_wish_is_set_and_the_users_is_kept():
    ours: dict[str, str] = {}
    runtime.prepare(ours)
    assert ours == {runtime.VARIABLE: runtime.ONE_WORKER}
    theirs = {runtime.VARIABLE: "(rx: (worker_threads: 4))"}
    runtime.prepare(theirs)
    assert theirs == {runtime.VARIABLE: "(rx: (worker_threads: 4))"}


def test_only_our_own_wish_is_forgotten():
    ours = {runtime.VARIABLE: runtime.ONE_WORKER, "OTHER": "1"}
    runtime.forget(ours)
    assert ours == {"OTHER": "1"}
    theirs = {runtime.VARIABLE: "(rx: (worker_threads: 4))"}
    runtime.forget(theirs)
    assert runtime.VARIABLE in theirs


def test_zenoh_takes_the_wish():
    """A session has one thread of the runtime; by default it has several kinds."""
    program = (
        "import json, pathlib, time, zenoh\n"
        "from fogft.wire import config\n"
        "session = zenoh.open(config.to_zenoh({'mode': 'peer', 'listen/endpoints': [],"
        " 'scouting/multicast/enabled': False}))\n"
        "names, end = [], time.monotonic() + 10\n"
        "while not any('-0' in n for n in names) and time.monotonic() < end:\n"  # named late
        "    tasks = pathlib.Path('/proc/self/task')\n"
        "    names = [t.read_text().strip() for t in tasks.glob('*/comm')]\n"
        "session.close()\n"
        "print(json.dumps(sorted(names)))\n"
    )
    out = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    names = json.loads(out)
    assert [name for name in names if name.startswith("net-")] == ["net-0"]
    assert not [name for name in names if name.startswith(("rx-", "tx-", "app-", "acc-"))]
