"""A VM that no replica ever runs on shuts itself down, with nobody's help."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from fogft import template_files
from fogft.cloud.sky import settings
from fogft.cloud.sky.following import LAUNCH_LIMIT_S
from fogft.model.names import SETUP_LIMIT_S
from tests.fakes.waiting import wait_for

LIMIT_S = 60.0


def machine(folder: Path, long_minute: int = 0) -> dict[str, str]:
    """Return the environment of a machine whose `shutdown` only writes.

    A minute passes there in a moment, and is counted; the long one ends when there is a file `on`.
    """
    waits = f'[ "$(wc -l < {folder}/minutes)" -ne {long_minute} ] || '
    waits += f"until [ -e {folder}/on ]; do /bin/sleep 0.01; done"
    programs = {
        "shutdown": f'#!/bin/sh\necho "$@" > {folder}/down\n',
        "poweroff": "#!/bin/sh\nexit 1\n",
        "sleep": f'#!/bin/sh\necho "$1" >> {folder}/minutes\n{waits}\nexec /bin/sleep 0.05\n',
    }
    for name, text in programs.items():
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    return {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"}


def start(folder: Path, minutes: int, long_minute: int = 0) -> subprocess.Popen[bytes]:
    text = template_files.read_text("vm_guard.sh").replace("@ALONE_MINUTES@", str(minutes))
    script = folder / "guard"
    # What other tests on this machine run is no replica of this one.
    script.write_text(text.replace("fogft[ ]serve", f"fogft[ ]serve-{folder}"))
    return subprocess.Popen(["sh", script, "stay"], env=machine(folder, long_minute))


def minutes(folder: Path) -> int:
    written = folder / "minutes"
    return len(written.read_text().split()) if written.exists() else 0


def until_minutes(folder: Path, count: int) -> None:
    wait_for(lambda: minutes(folder) >= count, LIMIT_S)


def test_a_machine_without_a_replica_shuts_down_at_its_limit(tmp_path: Path):
    assert start(tmp_path, minutes=5).wait(LIMIT_S) == 0
    assert (tmp_path / "down").read_text() == "-h now\n"
    assert (tmp_path / "minutes").read_text().split() == ["60"] * 5


def test_a_machine_whose_replica_runs_stays_and_its_time_begins_anew(tmp_path: Path):
    replica = subprocess.Popen(
        [sys.executable, "-c", "input()", "fogft", f"serve-{tmp_path}"], stdin=subprocess.PIPE
    )
    guarded = start(tmp_path, minutes=6, long_minute=12)
    try:
        until_minutes(tmp_path, 12)
        assert guarded.poll() is None
    finally:
        replica.kill()
        replica.wait()
        (tmp_path / "on").touch()
    assert guarded.wait(LIMIT_S) == 0
    assert (tmp_path / "down").exists()
    assert minutes(tmp_path) == 11 + 6


def test_its_command_returns_at_once_and_is_plain_text_for_every_reader(tmp_path: Path):
    """It goes through a command line, YAML twice and a shell before it is run."""
    command = settings.guard()
    assert "\n" not in command
    assert not set(command) & set("'\"#:{}[]%@`!?,")
    here = command.replace(settings.EACH_BOOT, str(tmp_path / "boot"))
    environ = machine(tmp_path)
    done = subprocess.run(["sh", "-c", here], env=environ, timeout=LIMIT_S, check=True)
    assert done.returncode == 0
    until_minutes(tmp_path, 2)  # it runs on, though its shell is gone
    text = (tmp_path / "boot/fogft-guard").read_text()
    assert f'"$alone" -lt {settings.ALONE_MINUTES} ' in text
    (tmp_path / "sleep").write_text("#!/bin/sh\nkill $PPID\n")  # its end


def test_its_limit_is_longer_than_a_launch_and_a_set_up_may_take():
    assert LAUNCH_LIMIT_S + SETUP_LIMIT_S <= settings.ALONE_MINUTES * 60
