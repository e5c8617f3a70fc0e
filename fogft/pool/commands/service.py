"""Write, start and remove systemd units for the parts of a pool on this machine.

They run the manager and three client proxies, two of which wait to take over; or a gateway or a
rendezvous with a configuration file. systemd restarts what dies or hangs, not what exits with 0.

Owns: the units' text and names, their environment, and the calls of systemctl.
Not here: what the processes tell systemd (`fogft.process`).
"""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fogft import disk, template_files
from fogft.child import python
from fogft.errors import FogftError, StateError
from fogft.pool.folder.paths import PoolPaths, home, own_folder
from fogft.pool.manager import process_control

SYSTEM_FOLDER = Path("/etc/systemd/system")
STANDBY_LIMIT_S = 60.0
HANDOVER_LIMIT_S = 180.0
MARK = "# Written by `fogft service install`"
# Variables that configure ROS 2, its middleware, fogft and clouds. No credentials: the clouds' own
# tools keep those in files.
_TAKEN = re.compile(
    r"ROS_.*|RMW_IMPLEMENTATION|AMENT_.*|COLCON_.*|CYCLONEDDS_URI|FAST(DDS|RTPS)_.*|ZENOH_.*|"
    r"SKYPILOT_API_SERVER_ENDPOINT|SKYPILOT_(GLOBAL_|PROJECT_)?CONFIG|"
    r"AWS_(DEFAULT_)?(PROFILE|REGION)|AWS_(CONFIG|SHARED_CREDENTIALS)_FILE|"
    r"GOOGLE_APPLICATION_CREDENTIALS|CLOUDSDK_CONFIG|KUBECONFIG|"
    r"OTEL_.*|PATH|PYTHONPATH|LD_LIBRARY_PATH|VIRTUAL_ENV|LANG|FOGFT_HOME"
)


@dataclass(frozen=True)
class Unit:
    """One unit's name and text, and the file with its environment."""

    name: str
    text: str
    environment: Path


@dataclass(frozen=True)
class Services:
    """The units of the `system`, or of this user."""

    system: bool

    @property
    def folder(self) -> Path:
        """The folder of the unit files."""
        ours = own_folder("XDG_CONFIG_HOME", "~/.config") / "systemd" / "user"
        return SYSTEM_FOLDER if self.system else ours

    def systemctl(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Call systemctl."""
        scope = [] if self.system else ["--user"]
        try:
            return subprocess.run(
                ["systemctl", *scope, *words], capture_output=True, text=True, check=False
            )
        except FileNotFoundError:
            raise FogftError("this machine has no systemd", "start each process yourself") from None


def names_of(pool: str) -> dict[str, str]:
    """Return the names of the units of a pool, by part."""
    return {
        part: f"fogft-{pool}-{part}.service"
        for part in ("manager", "proxy-a", "proxy-b", "proxy-c")
    }


def of_pool(paths: PoolPaths, *, system: bool) -> list[Unit]:
    """Return the units of a pool's manager and client proxies."""
    pool, root = paths.folder.name, paths.folder.parent.parent.resolve()
    environment = root / f"{pool}.service.env"  # a pool of that name may come after this one
    manager = ("manager", "--no-proxy", pool)
    proxy = ("proxy", "--spare", "--config", str(paths.proxy_config))
    return [
        _unit(
            *(name, manager if part == "manager" else proxy, paths.identity, environment),
            system=system,
        )
        for part, name in names_of(pool).items()
    ]


def of_part(command: str, config: Path, *, system: bool) -> list[Unit]:
    """Return the unit of a gateway or a rendezvous."""
    config = config.resolve()
    if not config.is_file():
        raise StateError(f"there is no `{config}`", "`fogft join` writes it")
    words = (command, "--config", str(config))
    environment = config.with_suffix(".env")
    name = f"fogft-{command}-{re.sub('[^A-Za-z0-9_.-]', '_', config.stem)}.service"
    return [_unit(name, words, config, environment, system=system)]


def _unit(name: str, words: Sequence[str], needs: Path, environment: Path, *, system: bool) -> Unit:
    command = " ".join(_quoted(word) for word in python("-m", "fogft", *words))
    text = template_files.read_text("systemd.service").format(
        mark=MARK,
        what=name.removeprefix("fogft-").removesuffix(".service"),
        needs=str(needs).replace("%", "%%"),
        command=command,
        environment=str(environment).replace("%", "%%"),
        user=f"User={needs.stat().st_uid}\n" if system else "",
        watchdog_s=120 if words[0] == "manager" else 30,  # a manager waits for its cloud
        wanted_by="multi-user.target" if system else "default.target",
    )
    return Unit(name, text, environment)


def _quoted(word: str) -> str:
    if re.fullmatch(r"[\w@/.:+,=-]+", word):
        return word
    escaped = word.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + escaped.replace("%", "%%").replace("$", "$$") + '"'


def environment(environ: Mapping[str, str] = os.environ) -> str:
    """Return an environment file with what ROS, its middleware and fogft need.

    HOME is left out: under `sudo` it is root's, and systemd sets that of the unit's user.
    """
    taken = {name: value for name, value in environ.items() if _TAKEN.fullmatch(name)}
    taken["FOGFT_HOME"] = str(home(environ).absolute())
    lines = []
    for name, value in sorted(taken.items()):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"').replace("`", "\\`")
        lines.append(f'{name}="{escaped}"'.replace("\n", " "))
    return "\n".join(lines) + "\n"


def install(where: Services, units: Sequence[Unit], paths: PoolPaths | None = None) -> list[str]:
    """Start units now and at each boot; return the errors of systemd.

    A pool's units replace the processes, if any, that run the pool now.
    """
    if not where.folder.is_dir():
        disk.make_folder(where.folder)
    there = disk.read_bytes(where.folder / units[0].name)
    if there is not None and _needs(there.decode(errors="replace")) != _needs(units[0].text):
        told = f"`{units[0].name}` runs something else"
        raise StateError(told, "remove it, or rename this configuration: a unit bears its name")
    disk.write_whole(units[0].environment, environment())
    for unit in units:
        disk.write_whole(where.folder / unit.name, unit.text)
        (where.folder / unit.name).chmod(0o644)
    names = [unit.name for unit in units]
    said = [where.systemctl("daemon-reload"), where.systemctl("enable", *names)]
    if not any(one.returncode for one in said):
        if paths is not None:  # not started by systemd: its own replace them
            for lock in (paths.manager_lock, paths.spare_lock, paths.standby_lock):
                process_control.end_holder(lock)
        said.append(where.systemctl("restart", "--no-block", *names))
    return [one.stderr.strip() for one in said if one.returncode]


def _needs(text: str) -> list[Path]:
    return [Path(path).resolve() for path in re.findall("^ConditionPathExists=(.*)$", text, re.M)]


def hand_over(paths: PoolPaths) -> None:
    """Make a client proxy that systemd did not start hand over to one that it did.

    When told to end, it hands over to the standby: that is awaited first, so no request is lost.
    Proxies that were surplus until then are restarted by systemd.
    """
    old = disk.holder(paths.proxy_lock)
    if old is None:
        return
    if process_control.wait_for(lambda: disk.is_locked(paths.standby_lock), STANDBY_LIMIT_S):
        gone = threading.Event()
        process_control.call_at_end(old, gone.set)
        with contextlib.suppress(ProcessLookupError):
            os.kill(old, signal.SIGTERM)
        gone.wait(HANDOVER_LIMIT_S)


def installed(where: Services, names: Sequence[str] = ()) -> list[str]:
    """Return the installed units, or those of these names that exist."""
    if not where.folder.is_dir():
        return []
    found = sorted(where.folder.glob("fogft-*.service"))
    ours = [path.name for path in found if (disk.read_bytes(path) or b"").startswith(MARK.encode())]
    return [name for name in ours if not names or name in names]


def states(where: Services, names: Sequence[str]) -> dict[str, str]:
    """Return each unit's state according to systemd; `unknown` if systemd does not run."""
    if shutil.which("systemctl") is None:
        return dict.fromkeys(names, "unknown")
    return {name: where.systemctl("is-active", name).stdout.strip() or "unknown" for name in names}


def remove(where: Services, names: Sequence[str]) -> str:
    """Stop units, and delete them and their environment; return systemd's error, if any."""
    runs, refused = shutil.which("systemctl") is not None, ""
    if runs and names:
        done = where.systemctl("disable", "--now", *names)
        refused = done.stderr.strip().rpartition("\n")[2] if done.returncode else ""
    for unit in (where.folder / name for name in names):
        text = unit.read_text()
        unit.unlink()  # first, as removing it may not be permitted
        for path in re.findall("^EnvironmentFile=(.*)$", text, re.MULTILINE):
            Path(path.replace("%%", "%")).unlink(missing_ok=True)
    if runs and names:
        where.systemctl("daemon-reload")
        where.systemctl("reset-failed", *names)
    return refused
