"""Zenoh calls back in one thread, unless the user says otherwise; other programs are left alone."""

from __future__ import annotations

import json
import subprocess
import sys

from fogft.link.zenoh import settings


def test_our_wish_is_set_and_the_users_is_kept():
    ours: dict[str, str] = {}
    settings.ask_for_threads(ours)
    assert ours == {settings.VARIABLE: settings.THREADS}
    theirs = {settings.VARIABLE: "(rx: (worker_threads: 4))"}
    settings.ask_for_threads(theirs)
    assert theirs == {settings.VARIABLE: "(rx: (worker_threads: 4))"}


def test_only_our_own_wish_is_forgotten():
    ours = {settings.VARIABLE: settings.THREADS, "OTHER": "1"}
    settings.forget_threads(ours)
    assert ours == {"OTHER": "1"}
    theirs = {settings.VARIABLE: "(rx: (worker_threads: 4))"}
    settings.forget_threads(theirs)
    assert settings.VARIABLE in theirs


def test_zenoh_takes_the_wish():
    """One thread reads and calls back, whoever sends or closes has his own; no other kinds."""
    program = (
        "import json, pathlib, time, zenoh\n"
        "from fogft.link.zenoh import settings as config\n"
        "session = zenoh.open(config.to_zenoh({'mode': 'peer', 'listen/endpoints': [],"
        " 'scouting/multicast/enabled': False}))\n"
        "names, end = [], time.monotonic() + 10\n"
        "wanted = {'rx-0', *(f'net-{n}' for n in range(8))}\n"
        "while not wanted <= set(names) and time.monotonic() < end:\n"  # named late
        "    tasks = pathlib.Path('/proc/self/task')\n"
        "    names = [t.read_text().strip() for t in tasks.glob('*/comm')]\n"
        "session.close()\n"
        "print(json.dumps(sorted(names)))\n"
    )
    out = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    names = json.loads(out)
    assert [name for name in names if name.startswith("rx-")] == ["rx-0"]
    assert {f"net-{number}" for number in range(8)} <= set(names)
    assert not [name for name in names if name.startswith(("app-", "acc-"))]
