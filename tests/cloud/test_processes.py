"""Finding processes by what they carry, and ending them for sure."""

from __future__ import annotations

import os
import secrets
import subprocess
import sys

import pytest

from fogft.cloud.local import processes
from fogft.errors import CloudUnreachable
from tests.fakes.waiting import wait_for


@pytest.fixture
def start():
    made: list[subprocess.Popen] = []

    def run(command: str, **marks: str) -> subprocess.Popen:
        made.append(
            subprocess.Popen(
                ["bash", "-c", command],
                env={**os.environ, **marks},
                start_new_session=True,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
        return made[-1]

    yield run
    for process in made:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.fixture
def uid():
    return secrets.token_hex(8)


def test_processes_are_found_by_machine_by_pool_and_by_both(start, uid):
    first = start("exec sleep 60", FOGFT_MACHINE=f"{uid}-0.1", FOGFT_POOL_UID=uid)
    second = start("exec sleep 60", FOGFT_MACHINE=f"{uid}-1.1", FOGFT_POOL_UID=uid)
    wait_for(lambda: len(processes.find(pool_uid=uid)) == 2)
    assert processes.find(pool_uid=uid) == sorted([first.pid, second.pid])
    assert processes.find(machine=f"{uid}-1.1") == [second.pid]
    assert processes.find(pool_uid=uid, machine=f"{uid}-0.1") == [first.pid]
    assert processes.find(pool_uid="0" * 16, machine=f"{uid}-0.1") == []
    assert {first.pid, second.pid} <= set(processes.find())


def test_a_mark_must_match_as_a_whole(start, uid):
    start("exec sleep 60", FOGFT_MACHINE=f"{uid}-0.11", OTHER=f"FOGFT_MACHINE={uid}-0.1")
    wait_for(lambda: processes.find(machine=f"{uid}-0.11"))
    assert processes.find(machine=f"{uid}-0.1") == []


def test_descendants_are_found_whatever_they_hide(start, uid):
    parent = start(
        "env -i setsid bash -c 'echo $$; exec sleep 60' & wait", FOGFT_MACHINE=f"{uid}-0.1"
    )
    hidden = int(parent.stdout.readline())
    assert processes.find(machine=f"{uid}-0.1") == sorted([parent.pid, hidden])
    assert processes.end_machine(f"{uid}-0.1")
    assert not processes.alive(hidden)
    assert not processes.end_machine(f"{uid}-0.1"), "there was nothing left"


def test_what_is_spared_lives_on(start, uid):
    kept = start("exec sleep 60", FOGFT_MACHINE=f"{uid}-0.1")
    ended = start("exec sleep 60", FOGFT_MACHINE=f"{uid}-0.1")
    wait_for(lambda: len(processes.find(machine=f"{uid}-0.1")) == 2)
    processes.end_machine(f"{uid}-0.1", spare={kept.pid})
    assert processes.alive(kept.pid)
    assert not processes.alive(ended.pid)


def test_this_process_is_never_found(uid):
    """Whoever cleans up does not end itself, though it carries the mark."""
    code = (
        "import os; from fogft.cloud.local import processes\n"
        "machine = os.environ['FOGFT_MACHINE']\n"
        "print(processes.find(machine=machine), processes.end_machine(machine))"
    )
    environ = {**os.environ, "FOGFT_MACHINE": f"{uid}-0.1", "PYTHONPATH": os.getcwd()}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environ, capture_output=True, text=True, check=True
    )
    assert done.stdout == "[] False\n"


def test_a_stopped_process_ends(start, uid):
    process = start("kill -STOP $$; sleep 60", FOGFT_MACHINE=f"{uid}-0.1")
    wait_for(lambda: processes.stopped(process.pid))
    assert processes.alive(process.pid)
    processes.end([process.pid])
    assert not processes.alive(process.pid)


def test_a_zombie_is_not_alive(start, uid):
    process = start("exit 0", FOGFT_MACHINE=f"{uid}-0.1")
    wait_for(lambda: not processes.alive(process.pid))
    assert processes.find(machine=f"{uid}-0.1") == []
    processes.end([process.pid])


def test_what_does_not_end_is_told(start, uid, monkeypatch):
    process = start("exec sleep 60", FOGFT_MACHINE=f"{uid}-0.1")
    monkeypatch.setattr(processes, "send", lambda pids, number: None)
    with pytest.raises(CloudUnreachable, match=f"do not exit: {process.pid}"):
        processes.end([process.pid], limit_s=0.05)


def test_a_programs_name_may_hold_anything(start, uid, tmp_path):
    odd = tmp_path / "a) Z 1 (b"
    odd.symlink_to("/bin/sleep")
    process = start(f"exec '{odd}' 60", FOGFT_MACHINE=f"{uid}-0.1")
    wait_for(lambda: processes.find(machine=f"{uid}-0.1") == [process.pid])
    assert processes.alive(process.pid)
