"""A log that grew too long keeps its end, while its writers go on."""

from __future__ import annotations

import os
from pathlib import Path

from fogft import logfile


def test_a_long_log_keeps_its_last_whole_lines(tmp_path: Path) -> None:
    log = tmp_path / "x.log"
    log.write_text("".join(f"line {n}\n" for n in range(1000)))
    logfile.bound(log, limit_bytes=2000, kept_bytes=100)
    lines = log.read_text().splitlines()
    assert lines[0] == "log_shortened"
    assert lines[1:] == [f"line {n}" for n in range(1000 - len(lines) + 1, 1000)]
    assert log.stat().st_size < 200


def test_a_short_log_and_a_missing_one_are_left_alone(tmp_path: Path) -> None:
    log = tmp_path / "x.log"
    logfile.bound(log)
    log.write_text("as it was\n")
    logfile.bound(log, limit_bytes=10)
    assert log.read_text() == "as it was\n"


def test_a_writer_goes_on_behind_what_was_kept(tmp_path: Path) -> None:
    log = tmp_path / "x.log"
    writer = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.write(writer, b"old\n" * 100)
    logfile.bound(log, limit_bytes=100, kept_bytes=9)
    os.write(writer, b"new\n")
    os.close(writer)
    assert log.read_text() == "log_shortened\nold\nold\nnew\n"


def test_the_tail_is_of_what_came_after_a_size(tmp_path: Path) -> None:
    log = tmp_path / "x.log"
    log.write_text("before\n")
    begin = logfile.size(log)
    with log.open("a") as file:
        file.write("a\nb\nc\n")
    assert logfile.tail(log, begin) == "a\nb\nc"
    assert logfile.tail(log, lines=2) == "b\nc"
    assert logfile.tail(tmp_path / "none.log") == ""
