"""Files are replaced whole or not at all; locks end with their holder and forgive a glance."""

from __future__ import annotations

import fcntl
import itertools
import json
import os
import resource
import signal
import stat
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fogft import disk, poll
from fogft.errors import StateError
from tests.fakes.threads import amid, waits_for
from tests.fakes.waiting import wait_for
from tests.needs import needs


def test_a_file_is_replaced_whole_and_private(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    disk.write_whole(path, "new")
    assert path.read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_text("old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StateError, match="cannot be written: No space left"):
        disk.write_whole(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_folder_is_a_clear_error(tmp_path):
    with pytest.raises(StateError, match="cannot be written"):
        disk.write_whole(tmp_path / "missing" / "file", "x")


def test_a_folder_that_cannot_be_made_is_a_clear_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(StateError, match="/file/home` cannot be created: Not a directory"):
        disk.make_folder(tmp_path / "file" / "home")


def test_a_folder_and_the_parents_made_for_it_are_private_and_others_stay(tmp_path):
    ours = tmp_path / "ours"
    ours.mkdir(mode=0o755)
    disk.make_folder(ours / "fogft" / "sky" / "locks")
    made = [ours, ours / "fogft", ours / "fogft" / "sky", ours / "fogft" / "sky" / "locks"]
    assert [one.stat().st_mode & 0o777 for one in made] == [0o755, 0o700, 0o700, 0o700]


def test_json_goes_round_and_a_missing_file_is_none(tmp_path):
    disk.write_json(tmp_path / "x.json", {"a": [1, None]})
    assert disk.read_json(tmp_path / "x.json") == {"a": [1, None]}
    assert disk.read_json(tmp_path / "y.json") is None


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"nul"])
def test_damaged_json_is_a_clear_error(tmp_path, content):
    (tmp_path / "x.json").write_bytes(content)
    with pytest.raises(StateError, match=r"x\.json"):
        disk.read_json(tmp_path / "x.json")


def test_a_reader_never_sees_half_a_file(tmp_path):
    path = tmp_path / "x.json"
    disk.write_json(path, {"n": 0, "pad": "x" * 10_000})
    done = threading.Event()

    def write() -> None:
        for n in range(200):
            disk.write_json(path, {"n": n, "pad": "x" * 10_000}, durable=False)
        done.set()

    threading.Thread(target=write).start()
    while not done.is_set():
        assert len(json.loads(path.read_text())["pad"]) == 10_000


def test_a_lock_is_exclusive_until_it_is_given_back(tmp_path):
    first, second = disk.Lock(tmp_path / "lock"), disk.Lock(tmp_path / "lock")
    assert first.acquire(wait=False)
    assert not second.acquire(wait=False)
    first.release()
    assert second.acquire(wait=False)
    second.release()


def test_a_lock_ends_with_its_process_whatever_ends_it(tmp_path):
    program = (
        "import sys, signal, pathlib; from fogft import disk\n"
        "disk_lock = disk.Lock(pathlib.Path(sys.argv[1])); disk_lock.acquire(wait=True)\n"
        "print('held', flush=True); signal.pause()\n"
    )
    path = tmp_path / "lock"
    with subprocess.Popen(
        [sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        assert disk.is_locked(path)
        holder.send_signal(signal.SIGKILL)
    assert not disk.is_locked(path)


def test_who_waits_for_a_lock_gets_it_when_its_killed_holder_has_ended_completely(
    tmp_path, monkeypatch
):
    dying = """if True:
        import ctypes, os, sys, threading, time
        from pathlib import Path
        from fogft.disk import Lock
        lock = Lock(Path(sys.argv[1]))
        assert lock.acquire(wait=False)
        def end_slowly():
            dead, waited_for, ended = map(Path, ["/proc/self/statm", *sys.argv[2:]])
            while dead.read_bytes().split()[0] != b"0" or not waited_for.exists():
                time.sleep(0.01)
            lock.release()
            time.sleep(0.2)
            ended.touch()
            os._exit(0)
        threading.Thread(target=end_slowly).start()
        ctypes.CDLL(None).pthread_exit(None)
    """
    is_ready = poll.is_ready  # on a busy machine its end takes longer
    monkeypatch.setattr(poll, "is_ready", lambda process, _: is_ready(process, 60.0))
    path, waited_for, ended = (tmp_path / name for name in ("lock", "waited-for", "ended"))
    holder = subprocess.Popen([sys.executable, "-c", dying, path, waited_for, ended])
    try:
        wait_for(lambda: disk.is_locked(path))
        with ThreadPoolExecutor(1) as threads:
            taken = amid(threads, lambda: disk.Lock(path).acquire(wait=True), path)
            waited_for.touch()
            assert taken.result()
        assert ended.exists()
    finally:
        holder.kill()
        holder.wait()


def test_a_glance_at_a_lock_refuses_nobody(tmp_path):
    """`is_locked` holds the lock for an instant; who wants it then must still get it."""
    path = tmp_path / "lock"
    stop = threading.Event()

    def glance() -> None:
        while not stop.is_set():
            disk.is_locked(path)

    path.touch()
    watcher = threading.Thread(target=glance)
    watcher.start()
    try:
        for _ in range(200):
            lock = disk.Lock(path)
            assert lock.acquire(wait=False)
            lock.release()
    finally:
        stop.set()
        watcher.join()


def test_a_glance_refuses_nobody_who_is_held_up_between_two_looks(tmp_path, monkeypatch):
    """However long: on a busy machine a moment is over before the second look."""
    path, now = tmp_path / "lock", itertools.count(step=3600.0)
    path.touch()
    glance = disk.Lock(path)
    assert glance.take(fcntl.LOCK_SH)
    monkeypatch.setattr("fogft.disk.time.monotonic", lambda: next(now))
    monkeypatch.setattr("fogft.disk.time.sleep", lambda _: glance.release())
    assert disk.Lock(path).acquire(wait=False)


def test_a_holder_is_known_though_the_kernels_list_lacks_it(tmp_path, monkeypatch):
    """A long list is read page by page, and skips some where others let go meanwhile."""
    read, lists = Path.read_text, ["", ""]

    def lacking(path: Path) -> str:
        return lists.pop() if lists and path == Path("/proc/locks") else read(path)

    monkeypatch.setattr(Path, "read_text", lacking)
    with disk.locked(tmp_path / "lock"):
        assert disk.holder(tmp_path / "lock", said=False) == os.getpid()
    assert not lists


def test_who_only_glances_is_not_taken_for_a_holder(tmp_path):
    """Holders are ended: by `fogft down`, and by a manager that replaces an older version's."""
    path = tmp_path / "lock"
    path.touch()
    glances: list[bool] = []

    def glance() -> None:
        glances.extend(disk.is_locked(path) for _ in range(500))

    watchers = [threading.Thread(target=glance) for _ in range(3)]
    for watcher in watchers:
        watcher.start()
    seen = set[int | None]()
    while any(watcher.is_alive() for watcher in watchers):
        seen.add(disk.holder(path, said=False))
    assert seen <= {None}
    assert not any(glances)


def test_nothing_is_locked_where_there_is_no_file(tmp_path):
    assert not disk.is_locked(tmp_path / "none")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_locked_in_a_folder_that_goes_at_that_moment(tmp_path):
    assert not disk.is_locked(tmp_path / "gone" / "lock")


def test_a_glance_at_a_lock_makes_no_file_in_a_folder_that_goes(tmp_path):
    """It would keep the folder there, and `fogft down` from removing it."""
    assert not disk.is_locked(tmp_path / "lock")
    assert list(tmp_path.iterdir()) == []


def test_who_waits_for_a_lock_whose_file_is_made_anew_has_not_the_old_one(tmp_path):
    """As an `up` that waits for a `down`, while another `up` creates the pool again."""
    path, freed, found = tmp_path / "lock", threading.Event(), []
    old, new = disk.Lock(path), disk.Lock(path)

    def wait() -> None:
        with disk.locked(path):
            found.append(freed.is_set())

    assert old.acquire(wait=False)
    waiting = threading.Thread(target=wait)
    waiting.start()
    wait_for(lambda: waits_for(path))
    path.unlink()
    assert new.acquire(wait=False)
    old.release()
    wait_for(lambda: found or waits_for(path))
    freed.set()
    new.release()
    waiting.join()
    assert found == [True]


def test_a_lock_in_a_folder_that_is_gone_is_a_clear_error(tmp_path):
    with pytest.raises(StateError, match="cannot be opened: No such file"):
        with disk.locked(tmp_path / "missing" / "lock"):
            pass


DISKS = """
set -e
mount -t tmpfs -o size=1m tmpfs "$1"
for state in free full free read-only; do
    rm -f "$1/fill"
    [ "$state" != full ] || head -c 2m /dev/zero >"$1/fill" 2>/dev/null || true
    [ "$state" != read-only ] || mount -o remount,ro "$1"
    "$2" -c "$3" "$1" "$state"
done
"""
TRIES = """
import sys
from pathlib import Path
from fogft import disk, poll
from fogft.errors import StateError
folder, state = Path(sys.argv[1]), sys.argv[2]
writes = {"report": disk.Report(folder / "report").write}
writes["other"] = lambda value: disk.write_json(folder / "other", value)
for write in writes.values():
    try:
        write([state] if state == "full" else [state, "more"])
    except StateError:
        pass
report, other = (disk.read_json(folder / name) for name in writes)
with disk.locked(folder / "lock"):
    held = disk.is_locked(folder / "lock")
print(disk.unwritable(folder), report[0], other[0], held, disk.is_locked(folder / "lock"))
"""


def test_a_report_is_written_where_no_descriptor_is_left(tmp_path):
    report = disk.Report(tmp_path / "report")
    report.write(["before"])
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
    try:
        report.write(["now"])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert disk.read_json(tmp_path / "report") == ["now"]
    (tmp_path / "report").unlink()
    report.write(["later"])
    assert disk.read_json(tmp_path / "report") == ["later"]
    report.close()


@needs("namespaces")
def test_a_disk_that_takes_nothing_more_is_known_and_a_report_is_written_on_a_full_one(tmp_path):
    """A shorter report takes the place of a longer one, whole; any other file stays as it is.

    Who holds a lock is known in each case.
    """
    words = ["unshare", "--mount", "bash", "-c", DISKS, "bash", str(tmp_path), sys.executable]
    done = subprocess.run([*words, TRIES], capture_output=True, text=True, timeout=100, check=False)
    assert [line.split(" ") for line in done.stdout.splitlines()] == [
        [why, reported, "free", "True", "False"]
        for why, reported in (("", "free"), ("full", "full"), ("", "free"), ("read-only", "free"))
    ], done.stderr


def test_a_lock_whose_file_was_removed_is_lost(tmp_path):
    """Another may hold that of a new file in its place."""
    lock = disk.Lock(tmp_path / "lock")
    assert not lock.lost
    assert lock.acquire(wait=False)
    assert not lock.lost
    (tmp_path / "lock").unlink()
    assert lock.lost
    (tmp_path / "lock").touch()
    assert lock.lost
    lock.release()
    assert not lock.lost


def test_a_folder_that_has_just_been_removed_is_not_full(tmp_path):
    assert disk.unwritable(tmp_path / "gone") == ""
