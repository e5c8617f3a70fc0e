"""A machine that boots systemd: its own root, processes, network and cgroups, all gone at the end.

Nothing of the machine that it runs on is written; see `boot.sh`.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from fogft.child import tied
from tests.fakes.waiting import wait_for

ROOT = Path(__file__).parents[2]
SYSTEMD = Path("/usr/lib/systemd/systemd")
CGROUPS = (Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/unified"))
_NAMESPACES = ("--mount", "--net", "--pid", "--fork", "--kill-child", "--mount-proc")


class Machine:
    """A machine that is being booted.

    Args:
        folder: An empty one of its own, below which it is laid out.
        cgroup: A folder of cgroup2 of its own.
    """

    def __init__(self, folder: Path, cgroup: Path) -> None:
        self._cgroup = cgroup
        wanted = {Path(one) for one in (str(ROOT), sys.prefix, sys.base_prefix)}
        kept = [str(one) for one in wanted if not wanted & set(one.parents)]
        kept = [one for one in kept if one not in ("/", "/usr")]
        self._log = (folder.parent / f"{folder.name}.log").open("w+b")
        script = str(Path(__file__).with_name("boot.sh"))
        boots = ["unshare", *_NAMESPACES, "bash", script, str(folder), str(cgroup), *sorted(kept)]
        self._holder = subprocess.Popen(
            tied(boots),  # whatever ends the tests ends the machine
            stdin=subprocess.DEVNULL, stdout=self._log, stderr=self._log, start_new_session=True,
        )  # fmt: skip

    def init(self) -> int | None:
        """Return the process that is the machine's first one; None while none runs."""
        pid = self._holder.pid
        with contextlib.suppress(OSError, ValueError):
            while Path(f"/proc/{pid}/comm").read_text() != "systemd\n":
                [child] = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
                pid = int(child)
            return pid
        return None

    def run(
        self, *words: str, user: str = "root", environ: Mapping[str, str] | None = None,
        ok: bool = True, limit_s: float = 120,
    ) -> str:  # fmt: skip
        """Run a command in the machine; return what it wrote."""
        init = self.init()
        assert init is not None, self.log()
        inside = ["nsenter", "--target", str(init), "--all"]
        asked = ["runuser", "--user", user, "--", *words] if user != "root" else list(words)
        path = "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin"
        done = subprocess.run(
            [*inside, "env", "-i", "--chdir=/", f"PATH={path}", *_set(environ or {}), *asked],
            capture_output=True, text=True, check=False, timeout=limit_s,
        )  # fmt: skip
        said = done.stdout + done.stderr
        assert not ok or done.returncode == 0, f"{' '.join(words)}: {done.returncode}\n{said}"
        return done.stdout if ok else said

    def outside(self, *words: str) -> list[str]:
        """Return a command for a program that is on the machine's network, and not on it."""
        return ["nsenter", "--target", str(self._holder.pid), "--net", *words]

    def booted(self) -> bool:
        """Whether everything that is started at boot has been."""
        if self.init() is None:
            assert self._holder.poll() is None, self.log()
            return False
        return self.run("systemctl", "is-system-running", ok=False).strip() in (
            "running",
            "degraded",
        )

    def await_boot(self, *, after: int | None = None) -> None:
        """Wait until it has booted, with another first process than the one named."""
        wait(lambda: self.init() != after and self.booted(), self.log)

    def cut_power(self) -> None:
        """End all at once, as nothing but a power cut does; it boots again."""
        init = self.init()
        assert init is not None
        os.kill(init, signal.SIGKILL)

    def log(self) -> str:
        """Return what the boot has said."""
        self._log.seek(0)
        return self._log.read().decode()

    def close(self) -> None:
        """End all of it."""
        self._holder.kill()
        self._holder.wait()
        self._log.close()
        wait(lambda: _removed(self._cgroup), lambda: "its cgroup is still used")


def _set(environ: Mapping[str, str]) -> list[str]:
    return [f"{name}={value}" for name, value in environ.items()]


def _removed(cgroup: Path) -> bool:
    for folder, _, _ in os.walk(cgroup, topdown=False):
        with contextlib.suppress(OSError):
            os.rmdir(folder)
    return not cgroup.exists()


def wait(condition: Callable[[], Any], told: Callable[[], object], limit_s: float = 120) -> Any:
    """Wait until a condition holds; return what it gave."""
    return wait_for(condition, limit_s, told=told, pause_s=0.2)


def _cgroups() -> Path | None:
    """Return where cgroup2 is mounted."""
    return next((one for one in CGROUPS if (one / "cgroup.procs").exists()
                 and (one / "cgroup.controllers").exists()), None)  # fmt: skip


@contextlib.contextmanager
def machine(folder: Path) -> Iterator[Machine]:
    """Boot a machine; it is gone afterwards."""
    above = _cgroups()
    assert above is not None
    folder.mkdir()
    cgroup = Path(tempfile.mkdtemp(prefix="fogft-boot-", dir=above))
    cgroup.chmod(0o755)  # a user's systemd makes its own below
    made = Machine(folder, cgroup)
    try:
        made.await_boot()
        yield made
    finally:
        made.close()


@functools.cache
def can_boot() -> bool:
    """Try whether a machine can be booted here: root, systemd, overlays, cgroup2, namespaces."""
    programs = ("unshare", "nsenter", "setpriv", "ip", "runuser", "useradd", "bash")
    if os.geteuid() or not SYSTEMD.exists() or not all(map(shutil.which, programs)):
        return False
    if _cgroups() is None:
        return False
    with tempfile.TemporaryDirectory() as folder:
        overlay = "mount -t tmpfs x $0 && mkdir $0/u $0/w $0/r && "
        overlay += "mount -t overlay -o lowerdir=/,upperdir=$0/u,workdir=$0/w x $0/r"
        tried = ["unshare", *_NAMESPACES, "--cgroup", "bash", "-c", overlay, folder]
        return subprocess.run(tried, capture_output=True, check=False).returncode == 0
