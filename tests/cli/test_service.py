"""`fogft service`: what systemd is given, judged by systemd, and what it is told."""

from __future__ import annotations

import os
import pwd
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from fogft import disk
from fogft.child import python
from fogft.cli import main
from fogft.pool.commands import service
from fogft.pool.folder.paths import PoolPaths
from fogft.process import Watchdog, notify
from tests.fakes.pools import lay_down
from tests.needs import needs


class Systemd:
    """Stands in for systemctl: notes what it is asked, and answers as told."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, refused: str = "") -> None:
        self.asked = folder / "asked"
        folder.mkdir()
        program = folder / "systemctl"
        refuses = f'case "$*" in {refused}) echo no >&2; exit 1 ;; esac\n' if refused else ""
        program.write_text(f'#!/bin/sh\necho "$@" >> {self.asked}\n{refuses}echo active\n')
        program.chmod(0o755)
        monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")


@pytest.fixture
def units(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A pool, a home for units, and an environment as of a sourced ROS 2."""
    lay_down(home, None)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "not to be written")
    monkeypatch.setenv("SKYPILOT_SERVICE_TOKEN", "not to be written")
    monkeypatch.setenv("SKYPILOT_API_SERVER_ENDPOINT", "http://sky:46580")
    monkeypatch.setenv("AWS_PROFILE", "fleet")
    return tmp_path / "config" / "systemd" / "user"


def test_units_are_written_started_shown_and_removed(home, units, tmp_path, monkeypatch, capsys):
    systemd = Systemd(tmp_path / "bin", monkeypatch)
    assert main.run(["service", "install"]) == 0
    names = [
        f"fogft-planner-{part}.service" for part in ("manager", "proxy-a", "proxy-b", "proxy-c")
    ]
    assert capsys.readouterr().out.split() == [str(units / name) for name in names]
    assert systemd.asked.read_text().splitlines() == [
        "--user daemon-reload",
        f"--user enable {' '.join(names)}",
        f"--user restart --no-block {' '.join(names)}",
    ]
    env_file = home / "planner.service.env"  # outlives the pool: another may get its name
    told = env_file.read_text()
    assert 'RMW_IMPLEMENTATION="rmw_fastrtps_cpp"\n' in told
    assert 'ROS_DOMAIN_ID="7"\n' in told
    assert 'SKYPILOT_API_SERVER_ENDPOINT="http://sky:46580"\n' in told
    assert 'AWS_PROFILE="fleet"\n' in told
    assert "not to be written" not in told
    assert env_file.stat().st_mode & 0o777 == 0o600
    manager = (units / names[0]).read_text()
    own = " ".join(python("-m", "fogft"))
    assert f"ExecStart={own} manager --no-proxy planner\n" in manager
    assert f"EnvironmentFile={env_file}\n" in manager
    assert main.run(["service", "status"]) == 0
    assert capsys.readouterr().out.splitlines() == [f"{name}  active" for name in names]
    assert main.run(["service", "remove"]) == 0
    assert list(units.iterdir()) == []
    assert main.run(["service", "status"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("refused", ["", "*enable*"])
def test_the_manager_yields_to_units_that_systemd_starts_and_to_no_others(
    home, units, tmp_path, monkeypatch, capsys, refused
):
    systemd = Systemd(tmp_path / "bin", monkeypatch, refused)
    order = []
    monkeypatch.setattr(
        service.process_control,
        "end_holder",
        lambda lock: order.append((lock, systemd.asked.read_text().count("restart"))),
    )
    assert main.run(["service", "install"]) == (1 if refused else 0)
    assert ("once your own systemd runs" in capsys.readouterr().err) == bool(refused)
    paths = PoolPaths.of("planner", home)
    ended = [] if refused else [paths.manager_lock, paths.spare_lock, paths.standby_lock]
    assert [name for name, _ in order] == ended
    assert not any(restarted for _, restarted in order)


def test_what_cannot_be_removed_keeps_its_environment(home, units, tmp_path, monkeypatch, capsys):
    """Without it the units that stay could not start at the next boot."""
    Systemd(tmp_path / "bin", monkeypatch)
    assert main.run(["service", "install"]) == 0
    unit = units / "fogft-planner-manager.service"
    text = unit.read_text()

    def refused(path, **_):
        raise PermissionError(1, "Operation not permitted", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refused)
        assert main.run(["service", "remove"]) == 1
    assert f"error: `{unit}`: Operation not permitted" in capsys.readouterr().err
    assert unit.read_text() == text
    assert (home / "planner.service.env").exists()


def test_a_home_in_which_no_unit_can_be_written_is_one_clear_error(
    home, units, tmp_path, monkeypatch, capsys
):
    Systemd(tmp_path / "bin", monkeypatch)
    (tmp_path / "config").touch()
    assert main.run(["service", "install"]) == 1
    assert f"error: `{units}` cannot be created: Not a directory" in capsys.readouterr().err


def test_a_unit_that_runs_something_else_stays(home, units, tmp_path, monkeypatch, capsys):
    """`join` calls the configuration of each gateway `gateway.yaml`."""
    Systemd(tmp_path / "bin", monkeypatch)
    one, other = [tmp_path / pool / "gateway.yaml" for pool in ("one", "other")]
    for config in (one, other):
        config.parent.mkdir()
        config.touch()
    assert main.run(["service", "install", "--gateway", str(one)]) == 0
    text = (units / "fogft-gateway-gateway.service").read_text()
    assert main.run(["service", "install", "--gateway", str(other)]) == 1
    assert "`fogft-gateway-gateway.service` runs something else" in capsys.readouterr().err
    assert (units / "fogft-gateway-gateway.service").read_text() == text
    assert main.run(["service", "install", "--gateway", str(one)]) == 0


def test_units_of_a_gateway_and_of_the_machine(tmp_path, monkeypatch):
    """A part with its own file; units of the machine run as the file's owner."""
    config = tmp_path / "edge 1%.yaml"
    config.write_text("")
    [unit] = service.of_part("gateway", config, system=True)
    assert f'gateway --config "{tmp_path}/edge 1%%.yaml"\n' in unit.text
    assert f"User={os.getuid()}\n" in unit.text
    assert unit.name == "fogft-gateway-edge_1_.service"
    assert "WantedBy=multi-user.target\n" in unit.text


def test_an_owner_needs_no_name(units, home, monkeypatch):
    """In a container it often has none; systemd takes its number."""
    monkeypatch.setattr(pwd, "getpwuid", {}.__getitem__)
    [unit, *_] = service.of_pool(PoolPaths.of("planner", home), system=True)
    assert f"User={os.getuid()}\n" in unit.text


def test_units_of_a_pool_that_is_shut_down_and_started_again_can_start(
    home, units, tmp_path, monkeypatch
):
    Systemd(tmp_path / "bin", monkeypatch)
    assert main.run(["service", "install"]) == 0
    assert main.run(["down", "--yes"]) == 0
    lay_down(home, None)
    unit = (units / "fogft-planner-manager.service").read_text()
    [path] = re.findall("^EnvironmentFile=(.*)$", unit, re.MULTILINE)
    assert Path(path).is_file()
    assert main.run(["service", "install"]) == 0, "it is still the same unit"


def test_units_of_one_pool_are_installed_again_by_another_path_to_it(
    home, units, tmp_path, monkeypatch
):
    Systemd(tmp_path / "bin", monkeypatch)
    assert main.run(["service", "install"]) == 0
    (tmp_path / "other").symlink_to(home)
    monkeypatch.setenv("FOGFT_HOME", str(tmp_path / "other"))
    assert main.run(["service", "install"]) == 0


def test_systemd_that_stops_no_unit_is_told(home, units, tmp_path, monkeypatch, capsys):
    """Without the user's bus, as under `sudo -u`: what runs goes on."""
    Systemd(tmp_path / "bin", monkeypatch, "*disable*")
    assert main.run(["service", "install"]) == 0
    assert main.run(["service", "remove"]) == 0
    assert "warning: systemd did not stop them: no\n" in capsys.readouterr().err


@needs("systemd")
def test_systemd_finds_nothing_wrong_with_the_units(home, units, tmp_path):
    paths = PoolPaths.of("planner", home)
    (home / "planner.service.env").write_text(service.environment())
    config = tmp_path / "rendezvous.yaml"
    config.write_text("")
    wanted = service.of_pool(paths, system=True)
    wanted += service.of_part("rendezvous", config, system=True)
    for unit in wanted:
        (tmp_path / unit.name).write_text(unit.text)
    judged = subprocess.run(
        ["systemd-analyze", "verify", *(str(tmp_path / unit.name) for unit in wanted)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (judged.returncode, judged.stderr) == (0, "")


def test_systemd_is_told_when_a_process_is_ready_and_that_it_works(tmp_path, monkeypatch):
    now = [100.0]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told:
        told.bind(str(tmp_path / "notify"))
        told.settimeout(10)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "4000000")
        notify("READY=1")
        assert told.recv(100) == b"READY=1"
        watchdog = Watchdog(lambda: now[0])
        for at in (100.0, 100.5, 101.0):
            now[0] = at
            watchdog.work()
        assert [told.recv(100), told.recv(100)] == [b"WATCHDOG=1"] * 2
        told.setblocking(False)
        with pytest.raises(BlockingIOError):
            told.recv(100)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    notify("READY=1")
    monkeypatch.delenv("WATCHDOG_USEC")
    Watchdog(lambda: now[0]).work()  # nobody asks


def test_the_client_proxy_that_runs_gives_way_once_another_stands_by(home, units):
    """It is told to end, never killed."""
    paths = PoolPaths.of("planner", home)
    holds = (
        "import fcntl, sys; file = open(sys.argv[1], 'w'); fcntl.flock(file, 2);"
        "print(flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", holds, str(paths.proxy_lock)]
    with subprocess.Popen(command, stdin=-1, stdout=-1) as old:
        assert old.stdout is not None
        old.stdout.readline()
        with disk.locked(paths.standby_lock):
            service.hand_over(paths)
        assert old.wait(20) == -signal.SIGTERM


@pytest.mark.parametrize("there", [True, False])
def test_units_without_ros_are_warned_of(home, units, tmp_path, monkeypatch, capsys, there):
    """As under `sudo -E`, which drops `PYTHONPATH`: the client proxies would fail at each boot."""
    Systemd(tmp_path / "bin", monkeypatch)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: object() if there else None)
    assert main.run(["service", "install"]) == 0
    assert ("the units have no ROS 2" in capsys.readouterr().err) is not there
