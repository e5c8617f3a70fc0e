"""What a machine takes from its processes for a while: room, descriptors, its disk, a folder."""

from __future__ import annotations

import contextlib
import resource
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

Fault = Callable[[Path, Sequence[int]], contextlib.AbstractContextManager[None]]


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """Mount a file system of 4 MB of its own; yield a folder in it."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m,mode=700", "tmpfs", str(folder)]
    subprocess.run(mount, check=True)
    try:
        (inner := folder / "pool").mkdir()
        yield inner
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@contextlib.contextmanager
def full(folder: Path, pids: Sequence[int]) -> Iterator[None]:
    filler = folder.parent / "filler"
    with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(bytes(4096)):
            pass
    yield
    filler.unlink()


@contextlib.contextmanager
def without_descriptors(folder: Path, pids: Sequence[int]) -> Iterator[None]:
    before = {pid: resource.prlimit(pid, resource.RLIMIT_NOFILE) for pid in pids}
    for pid, (_, most) in before.items():
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (3, most))
    yield
    for pid, limits in before.items():
        resource.prlimit(pid, resource.RLIMIT_NOFILE, limits)


@contextlib.contextmanager
def read_only(folder: Path, pids: Sequence[int]) -> Iterator[None]:
    """Lay the folder over itself, read-only: what is open stays so, nothing new is.

    It is made read-only aside, where nobody writes: else the kernel may find it busy.
    """
    aside = folder.with_name(f"{folder.name}-aside")
    aside.mkdir()
    for command in (
        ["mount", "--bind", folder, aside],
        ["mount", "-o", "remount,bind,ro", aside],
        ["mount", "--bind", aside, folder],
        ["umount", aside],
    ):
        subprocess.run(command, check=True)
    aside.rmdir()
    yield
    subprocess.run(["umount", "--lazy", folder], check=True)


@contextlib.contextmanager
def removed(folder: Path, pids: Sequence[int]) -> Iterator[None]:
    away = folder.rename(folder.with_name("away"))
    yield
    away.rename(folder)


FAULTS: dict[str, Fault] = {
    "full": full,
    "without_descriptors": without_descriptors,
    "read_only": read_only,
    "removed": removed,
}
