"""What ``fogft status`` shows, to a person and to a program."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
from dataclasses import fields, replace

import pytest

from fogft import disk
from fogft.cli import main, status
from fogft.cli.status_text import age, milliseconds, number
from fogft.pool.commands.status import Seen
from fogft.pool.manager.status import PoolStatus
from tests.fakes.pools import STATUS, alive, lay_down, report, reporting

SCREEN = """\
planner  answering  1 of 3 ready  $0.063/h on local  seen 0.4 s ago

REPLICA  PHASE     LOCATION                $/H  LINK            RTT  FIRST    AGE
0.1      ready     local/us-west-2/a     0.021  up          0.42 ms  1 412  7 min
1.12     starting  local/eu-central-1/b  0.020  connecting        -      0  4.2 s
2.3      draining  local/us-west-2/a     0.021  suspect      1.25 s      7   26 h

1.12  `/plan` is not up yet
2.3   silent for 17 s, and so it is replaced by another one elsewhere

SERVICE  READY  REQUESTS  ANSWERED  FALLBACK  UNANSWERED   LATE  WAITING      P50     P99
/plan        1     1 424     1 416         3           5  2 801        2  21.3 ms  148 ms

note: waiting after 3 failed launches (capacity)
"""


KEYS = {f.name for f in fields(PoolStatus)} | {f.name for f in fields(Seen)} - {"status"}


def without_age(screen: str) -> str:
    """Return a screen with the one thing in it that depends on the clock made the same."""
    return re.sub(r"seen [\d.]+ s ago", "seen 0.4 s ago", screen)


def test_the_screen_at_100_columns(home, capsys):
    paths = lay_down(home)
    with alive(paths):
        assert main.run(["status"]) == 0
    said = capsys.readouterr()
    assert without_age(said.out) == SCREEN
    assert said.err == ""


def test_a_pipe_gets_one_line_for_each_replica(home, capsys, monkeypatch):
    """Nothing is cut or broken into lines for a reader that is a program."""
    monkeypatch.delenv("COLUMNS")
    paths = lay_down(home)
    with alive(paths):
        main.run(["status"])
    rows = [line for line in capsys.readouterr().out.splitlines() if re.match(r"\d+\.\d+ ", line)]
    assert [row.split()[0] for row in rows] == ["0.1", "1.12", "2.3"]
    assert rows[1].endswith("4.2 s  `/plan` is not up yet")


def test_json_is_the_managers_status_with_what_is_known_now(home, capsys):
    paths = lay_down(home)
    with alive(paths):
        assert main.run(["status", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert set(said) == KEYS
    assert said["manager_alive"] is True
    assert 0.4 <= said["age_s"] < 60
    assert said["replicas"][0] == json.loads(paths.status.read_text())["replicas"][0]


def test_a_dead_manager_is_told_twice(home, capsys):
    """In the data, for whoever reads it alone, and as a warning with what to do."""
    paths = lay_down(home, replace(STATUS, file="/home/my robot/pool.yaml"))
    with disk.locked(paths.proxy_lock):
        assert main.run(["status"]) == 0
    said = capsys.readouterr()
    assert "NO MANAGER" in said.out
    assert said.err == (
        "warning: no manager is running: requests continue, but lost replicas are not replaced\n\n"
        "hint: start one with `fogft up '/home/my robot/pool.yaml'`, or shut the pool down with "
        "`fogft down`\n"
    )


@pytest.mark.parametrize("age_s", [40, -70])
def test_a_manager_that_hangs_is_told(home, capsys, age_s):
    """What it saw may lie ahead, where the clock was set back since."""
    paths = lay_down(home, age_s=age_s)
    with alive(paths):
        main.run(["status"])
    assert re.search(
        r"the manager has not observed the pool for [4-9]\d s", capsys.readouterr().err
    )


@pytest.mark.parametrize("why", ["full", "read-only"])
def test_a_full_disk_is_told_instead(home, capsys, monkeypatch, why):
    """It is why what is shown is old; the manager is not to blame."""
    monkeypatch.setattr(disk, "unwritable", lambda folder: why)
    paths = lay_down(home, age_s=40)
    with alive(paths):
        main.run(["status"])
    said = capsys.readouterr().err
    assert said.startswith(f"warning: the disk of `{paths.folder}` is {why}: ")
    assert "`unmanaged_max_hours`" in said  # leases need a file there
    assert "observed" not in said
    main.run(["status"])  # without a manager, which cannot start either
    fix = f"the disk of `{paths.folder}` is {why}: fix that, then start one with"
    assert f"hint: {fix}" in capsys.readouterr().err


def test_what_sounds_alarm_stands_in_the_first_line(home, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    status = replace(STATUS, uplink_suspected=True, stopping=True)
    paths = lay_down(home, status)
    main.run(["status"])
    first = capsys.readouterr().out.splitlines()[0]
    assert first.endswith("NO MANAGER  NO CLIENT PROXY  ENDING")
    with disk.locked(paths.proxy_lock):
        main.run(["status"])
    first = capsys.readouterr().out.splitlines()[0]
    assert first.endswith("NO MANAGER  UPLINK SUSPECTED  ENDING")


def test_what_died_long_ago_is_not_shown_as_it_was(home, capsys):
    """78 s after everything has died: no link, no phase, no price, and no answer."""
    paths = lay_down(home, age_s=78)
    report(paths, age_s=78)
    assert main.run(["status", "--check"]) == 1
    said = capsys.readouterr()
    first, _, _, *rows = said.out.splitlines()
    assert first.startswith("planner  not answering  ? of 3 ready  ?/h on local  seen 78 s ago")
    for row in rows[:3]:
        assert re.fullmatch(r"\d\.\d+ +\? +local/\S+ +\S+ +\? +\? .*", row), row
    assert said.err.startswith("warning: no manager is running: nothing is replaced")


def test_a_replica_that_has_served_is_not_starting(home, capsys):
    """One that was frozen, or whose service died, is told from one that is still new."""
    new = replace(STATUS.replicas[1], link="suspect")
    paths = lay_down(home, replace(STATUS, replicas=(new, replace(new, slot=2, has_served=True))))
    with alive(paths):
        main.run(["status"])
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[3:5]]
    assert [row[:2] for row in rows] == [["1.12", "starting"], ["2.12", "unready"]]


def test_a_client_proxy_that_hangs_is_not_believed(home, capsys, monkeypatch):
    """It lives, but its report is old: whether it answers is not known, and `--check` fails."""
    monkeypatch.setattr(status, "CHECK_LIMIT_S", 0.0)
    paths = lay_down(home)
    report(paths, age_s=12)
    with alive(paths):
        assert main.run(["status", "--check"]) == 1
        assert "planner  answering?  ? of 3 ready" in (said := capsys.readouterr()).out
        assert "links seen 12 s ago" in said.out
    assert "has reported nothing for 12 s: whether it answers is unknown" in said.err
    assert f"cannot write to `{paths.folder}`" in said.err


def test_a_check_asks_each_link_anew(home, capsys, monkeypatch):
    """A link that was up at the last report, and answers no probe now, does not count."""
    monkeypatch.setattr(status, "CHECK_LIMIT_S", 0.2)
    paths = lay_down(home)
    with alive(paths):
        assert main.run(["status", "--check"]) == 1
    assert "not answering" in capsys.readouterr().out

    def proxy() -> None:
        while not checked.wait(0.05):
            report(paths, age_s=-0.3)

    monkeypatch.setattr(status, "CHECK_LIMIT_S", 30.0)
    checked, thread = threading.Event(), threading.Thread(target=proxy)
    with alive(paths):
        thread.start()
        try:
            assert main.run(["status", "--check"]) == 0
        finally:
            checked.set()
            thread.join()
    assert "planner  answering" in capsys.readouterr().out


def test_why_a_stateful_service_cannot_be_had_stands_below(home, capsys):
    (service,) = STATUS.services
    counters = {**service.counters, "order": {"trouble": "all replicas are away"}}
    lay_down(home, replace(STATUS, services=(replace(service, counters=counters),)))
    main.run(["status"])
    said = capsys.readouterr().out.splitlines()
    assert "note: `/plan` is unavailable: all replicas are away" in said


def test_a_pool_that_nobody_looked_at_yet_has_the_same_schema(home, capsys):
    lay_down(home, None)
    assert main.run(["status", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert set(said) == KEYS
    assert said["age_s"] is None
    main.run(["status"])
    assert "not observed yet" in capsys.readouterr().out


def test_a_status_of_another_version_is_an_error(home, capsys):
    paths = lay_down(home)
    paths.status.write_text('{"pool": "planner", "replicas": [], "services": []}')
    assert main.run(["status"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"error: `{paths.status}` is not a status file: ")
    assert "remove it" in said


def test_which_pool_is_meant_must_be_clear(home, capsys):
    assert main.run(["status"]) == 1
    assert "error: no pools on this machine\n\nhint: start one" in capsys.readouterr().err
    for name in ("planner", "detector"):
        lay_down(home, replace(STATUS, pool=name))
    assert main.run(["status"]) == 1
    said = "there are 2 pools: `detector`, `planner`\n\nhint: name one with `--pool NAME`\n"
    assert said in capsys.readouterr().err
    assert main.run(["status", "detector"]) == 0
    assert capsys.readouterr().out.startswith("detector  ")
    assert main.run(["status", "planer"]) == 1
    assert "there is no pool `planer`" in capsys.readouterr().err


def on_a_terminal(home, **environ: str) -> str:
    """Return what ``fogft status`` sends to a terminal of 100 columns."""
    leader, follower = pty.openpty()
    try:
        subprocess.run(
            [sys.executable, "-m", "fogft", "status"],
            stdin=follower,
            stdout=follower,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "100", **environ},
            check=True,
        )
    finally:
        os.close(follower)
    sent = b""
    try:
        while chunk := os.read(leader, 65536):
            sent += chunk
    except OSError:  # the terminal has no more
        pass
    os.close(leader)
    return sent.decode()


def test_a_narrow_terminal_is_redrawn_with_all_that_a_wide_one_shows(home):
    """No column is cut, shortened or left out: what does not fit stands below."""
    paths = lay_down(home)
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 25, 60, 0, 0))
    environ = {name: value for name, value in os.environ.items() if name != "COLUMNS"}
    watch = [sys.executable, "-m", "fogft", "status", "--watch"]
    sent = b""
    with reporting(paths):
        with subprocess.Popen(
            watch, stdout=follower, stderr=subprocess.PIPE, env={**environ, "TERM": "xterm"}
        ) as process:
            while sent.count(b"planner") < 2:
                sent += os.read(leader, 65536)
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 130
    os.close(follower)
    os.close(leader)
    screen = re.sub(r"\033\[[0-9;?]*[a-zA-Z]", "", sent.decode()).splitlines()
    assert all(len(line) <= 60 for line in screen)
    first, second = [line.split() for line in screen if line.startswith("0.1 ")][:2]
    assert first == ["0.1", "ready", "local/us-west-2/a", "0.021", "up"]
    assert second == ["0.1", "0.42", "ms", "1", "412", "7", "min"]


@pytest.mark.parametrize("columns", [60, 80, 120, 200])
def test_a_screen_fits_its_terminal_and_breaks_no_word(home, capsys, monkeypatch, columns):
    """Each word of the widest screen stands whole on a narrower one, but a place at its slash."""
    monkeypatch.setenv("COLUMNS", str(columns))
    paths = lay_down(home)
    with alive(paths):
        assert main.run(["status"]) == 0
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= columns
    assert set(SCREEN.split()) - set(shown.split()) <= {"0.4", "local/eu-central-1/b"}


def test_a_terminal_is_spared_columns_that_say_nothing(home, capsys, monkeypatch):
    """A pipe is not: whoever reads it counts columns."""
    (service,) = STATUS.services
    quiet = {**service.counters, "fallback": 0, "silent": 0, "turned_away": 0, "pending": 0}
    paths = lay_down(home, replace(STATUS, services=(replace(service, counters=quiet),)))
    with alive(paths):
        main.run(["status"])
        shown = capsys.readouterr().out
        monkeypatch.delenv("COLUMNS")
        main.run(["status"])
        piped = capsys.readouterr().out
    for name in ("FALLBACK", "UNANSWERED", "WAITING"):
        assert name not in shown
        assert name in piped
    assert "LATE" in shown


def test_a_terminal_gets_colour_unless_it_wants_none(home):
    with reporting(lay_down(home)):
        assert "\033[32mready" in on_a_terminal(home)
        for environ in ({"NO_COLOR": "1"}, {"TERM": "dumb"}):
            plain = on_a_terminal(home, **environ)
            assert "\033" not in plain
            assert "0.1      ready" in plain


def test_colour_moves_nothing(home, capsys):
    """The coloured screen without its codes is the plain one."""
    with reporting(lay_down(home)):
        coloured = on_a_terminal(home).replace("\r\n", "\n")
    stripped = re.sub(r"\033\[[0-9;]*m", "", coloured)
    lines = [
        line.rstrip() for line in re.sub(r"seen \S+ s ago", "seen 0.4 s ago", stripped).splitlines()
    ]
    assert lines == SCREEN.splitlines()


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (9.9, "9.9 s"), (42, "42 s"), (150, "2 min"), (3900, "1 h 5 min"),
     (36_000, "10 h"), (90_000, "25 h"), (200_000, "2 d")],
)  # fmt: skip
def test_ages(seconds, text):
    assert age(seconds) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "-"), (0.00042, "0.42 ms"), (0.0123, "12.3 ms"), (0.5, "500 ms"), (1.2, "1.20 s")],
)
def test_milliseconds(seconds, text):
    assert milliseconds(seconds) == text


def test_thousands():
    assert number(1234567) == "1 234 567"
