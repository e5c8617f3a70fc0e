"""How a command ends: exit status, and what stands on which stream."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import fogft
from fogft.cli import main
from fogft.errors import PoolNotFound
from fogft.pool.commands import composition
from fogft.process import on_thread
from tests.fakes.pools import lay_down
from tests.fakes.threads import no_more


def run_failing(monkeypatch: pytest.MonkeyPatch, problem: BaseException) -> int:
    def fail(*_: object) -> None:
        raise problem

    monkeypatch.setattr(composition, "store_of", fail)
    return main.run(["drain", "0"])


def test_an_error_is_told_on_stderr_with_its_hint_after_a_blank_line(monkeypatch, capsys):
    problem = PoolNotFound("there is no pool `a`", "start one with `fogft up`")
    assert run_failing(monkeypatch, problem) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == "error: there is no pool `a`\n\nhint: start one with `fogft up`\n"


def test_an_error_without_a_hint_is_one_line(monkeypatch, capsys):
    assert run_failing(monkeypatch, PoolNotFound("there is no pool `a`")) == 1
    assert capsys.readouterr().err == "error: there is no pool `a`\n"


def test_where_no_thread_can_start_it_is_an_error_that_says_what_to_check(monkeypatch, capsys):
    with no_more(), pytest.raises(OSError) as caught:
        on_thread(print)
    assert run_failing(monkeypatch, caught.value) == 1
    assert "check `ulimit -u`" in capsys.readouterr().err


def test_a_defect_of_ours_keeps_its_trace(monkeypatch):
    """Anything but a `FogftError` is not caught."""
    with pytest.raises(ZeroDivisionError):
        run_failing(monkeypatch, ZeroDivisionError("defect"))


def test_a_down_that_is_interrupted_says_what_does_the_rest(home, monkeypatch, capsys):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    lay_down(home)
    monkeypatch.setattr("fogft.pool.manager.shutdown.end", interrupted)
    assert main.run(["down", "--yes"]) == 130
    assert capsys.readouterr().err == "interrupted: `fogft down planner` does the rest\n"


def test_a_file_that_is_not_ours_is_an_error_and_no_trace(tmp_path, monkeypatch, capsys):
    pools, loop = tmp_path / "pools", tmp_path / "loop"
    pools.write_text("no folder")
    loop.symlink_to(loop)
    monkeypatch.setenv("FOGFT_HOME", str(tmp_path))
    assert main.run(["list"]) == 1
    assert capsys.readouterr().err == f"error: `{pools}`: Not a directory\n"
    for home, command in ((pools, "list"), (loop, "doctor")):
        monkeypatch.setenv("FOGFT_HOME", str(home))
        assert main.run([command]) == 1
        told = f"error: `{home}` is not a folder\n\nhint: set FOGFT_HOME to a folder\n"
        assert capsys.readouterr().err == told


def test_no_room_for_temporary_files_is_an_error_that_names_tmpdir(monkeypatch, capsys):
    """It is raised by `tempfile`, without the name of a file."""
    none = OSError(errno.ENOENT, "No usable temporary directory found in ['/tmp']")
    assert run_failing(monkeypatch, none) == 1
    said = capsys.readouterr().err
    assert said.startswith("error: an open file: No usable temporary directory found in ['/tmp']\n")
    assert "set TMPDIR" in said


def test_what_a_locale_cannot_write_is_replaced(home):
    script = "import fogft.cli.main as m, sys; m.run = lambda _: print('\u2588'); m.main([])"
    environ = {**os.environ, "FOGFT_HOME": str(home), "PYTHONIOENCODING": "latin-1"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environ, capture_output=True, check=True
    )
    assert done.stdout == b"?\n"


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_without_stdout_or_stderr_the_work_is_done_all_the_same(home, tmp_path, closed):
    """No file that is opened may take the place of either."""
    done = subprocess.run(
        ["sh", "-c", f"{sys.executable} -m fogft init echo --into {tmp_path / 'new'} {closed}"],
        env={**os.environ, "FOGFT_HOME": str(home)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "new" / "pool.yaml").read_text().count("done:") == 0


def test_a_full_disk_behind_stdout_is_an_error_and_no_trace(home, tmp_path):
    done = subprocess.run(
        ["sh", "-c", f"{sys.executable} -m fogft --help > /dev/full"],
        env={**os.environ, "FOGFT_HOME": str(home), "PYTHONUNBUFFERED": ""},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith("error: an open file: No space left on device\n\nhint: ")
    assert len(done.stderr.splitlines()) == 3, done.stderr


def test_a_broken_pipe_that_is_not_stdout_is_a_defect_of_ours(monkeypatch):
    """Only a closed stdout is excused: a socket that breaks must not end us in silence."""
    with pytest.raises(BrokenPipeError):
        run_failing(monkeypatch, BrokenPipeError("a socket"))


def test_an_interrupt_is_one_line_and_130(monkeypatch, capsys):
    assert run_failing(monkeypatch, KeyboardInterrupt()) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_version_is_data(capsys):
    assert main.run(["--version"]) == 0
    said = capsys.readouterr()
    assert said.out == f"fogft {fogft.__version__}\n"
    assert said.err == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["frobnicate"], "no such command 'frobnicate'"),
        (["scale"], "missing command"),
        (["scale", "up"], "missing argument 'N'"),
        (["scale", "up", "0"], "invalid value for 'N': "),
        (["drain", "-1"], "no such option: -1"),
        (["status", "--josn"], "no such option: --josn"),
        (["proxy"], "missing option '--config' / '-c'"),
    ],
)
def test_wrong_usage_is_2_with_a_way_to_help(arguments, message, capsys):
    assert main.run(arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.lower().startswith(f"error: {message}".lower())
    assert "\n\nhint: see `fogft" in said.err
    assert said.err.endswith("--help`\n")


@pytest.mark.parametrize("arguments", [["retry"], ["drain", "0"], ["scale", "up", "1"]])
def test_a_pool_in_the_wrong_place_is_told_the_right_one(arguments, capsys):
    assert main.run([*arguments, "planner"]) == 2
    words = " ".join(word for word in arguments if word.isalpha())
    hint = f"see `fogft {words} --help`; name a pool with `--pool NAME`\n"
    assert capsys.readouterr().err.endswith(hint)
    assert main.run(["list", "planner"]) == 2
    assert capsys.readouterr().err.endswith("see `fogft list --help`\n")


@pytest.mark.parametrize(
    ("arguments", "message", "hint"),
    [
        (["drain", "2.1"], "'SLOT': '2.1' is not a whole number", "the slot of replica `2.1` is 2"),
        (["scale", "up", "101"], "'N': 101 is not in the range 1<=x<=100", "see `fogft scale up"),
        (["up", "--timeout", "x"], "'--timeout': 'x' is not a number", "see `fogft up --help`"),
    ],
)
def test_a_wrong_value_is_told_in_our_words(arguments, message, hint, capsys):
    assert main.run(arguments) == 2
    said = capsys.readouterr().err
    assert f"error: invalid value for {message}\n" in said
    assert hint in said


def test_no_command_shows_the_help_as_wrong_usage(capsys):
    assert main.run([]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("Usage: fogft")


def test_a_reader_that_left_gets_no_trace():
    """``fogft --help | head -0`` says nothing on stderr."""
    reading, writing = os.pipe()
    os.close(reading)
    try:
        ended = subprocess.run(
            [sys.executable, "-m", "fogft", "--help"],
            stdout=writing,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    finally:
        os.close(writing)
    assert ended.stderr == ""
    assert ended.returncode == 141


def test_control_c_while_it_waits_is_one_line(tmp_path):
    """A real SIGINT to a real process: one line, status 130, no trace."""
    code = (
        "import time; from fogft.cli import main; from fogft.pool.commands import composition\n"
        "def wait(name):\n"
        "    print('waiting', flush=True)\n"
        "    while True: time.sleep(0.1)\n"
        "composition.store_of = wait\n"
        "main.main(['drain', '0'])"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "waiting\n"
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=100)
    assert stderr == "interrupted\n"
    assert process.returncode == 130


def test_a_manager_run_by_hand_tells_why_it_cannot(home: Path) -> None:
    """It ends as every command does: an error and a hint, no trace."""
    identity = lay_down(home, None).identity
    identity.write_text(identity.read_text().replace('"local"', '"mars"'))
    said = run_by_hand()
    assert said.startswith("error: there is no cloud `mars`\n\nhint: clouds: `local`, `sky`")
    identity.unlink()
    assert "error: there is no pool `planner`" in run_by_hand()


def run_by_hand() -> str:
    """Run it, which fails; return what it says."""
    words = [sys.executable, "-m", "fogft", "manager", "planner"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 1, ended.stderr
    return ended.stderr


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch, capsys):
    """In a container a user often has no name, and without HOME no home."""
    for name in ("HOME", "FOGFT_HOME", "XDG_STATE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    for words in (["list"], ["service", "status"]):
        assert main.run(words) == 1
        assert "error: this user has no home folder\n\nhint: set HOME" in capsys.readouterr().err
