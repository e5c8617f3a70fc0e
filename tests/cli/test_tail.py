"""Following a log loses no line, whatever happens to the file."""

from __future__ import annotations

import pytest

from fogft.cli.status import Tail, in_order


@pytest.mark.parametrize(("last", "expected"), [(0, []), (1, ["c"]), (2, ["b", "c"]), (9, "abc")])
def test_it_begins_with_the_last_lines(tmp_path, last, expected):
    log = tmp_path / "log"
    log.write_text("a\nb\nc\n")
    assert list(Tail(log, last).new_lines()) == list(expected)


def test_the_last_lines_of_a_long_file_are_found(tmp_path):
    log = tmp_path / "log"
    log.write_text("".join(f"line {n} {'x' * 100}\n" for n in range(5000)))
    assert [line.split()[1] for line in Tail(log, 1500).new_lines()] == [
        str(n) for n in range(3500, 5000)
    ]


def test_half_a_line_waits_for_its_end(tmp_path):
    log = tmp_path / "log"
    log.write_text("a\nhal")
    tail = Tail(log, None)
    assert list(tail.new_lines()) == ["a"]
    with log.open("a") as file:
        file.write("f\n")
    assert list(tail.new_lines()) == ["half"]


def test_a_file_that_appears_later_is_shown_whole(tmp_path):
    tail = Tail(tmp_path / "log", 1)
    assert list(tail.new_lines()) == []
    (tmp_path / "log").write_text("a\nb\n")
    assert list(tail.new_lines()) == ["a", "b"]


def test_a_file_that_was_replaced_or_cut_is_shown_from_its_beginning(tmp_path):
    log = tmp_path / "log"
    log.write_text("a\nb\n")
    tail = Tail(log, None)
    assert list(tail.new_lines()) == ["a", "b"]
    log.write_text("c\n")
    assert list(tail.new_lines()) == ["c"]
    (tmp_path / "new").write_text("d\ne\nf\n")
    (tmp_path / "new").replace(log)
    assert list(tail.new_lines()) == ["d", "e", "f"]


def test_bytes_that_are_no_text_do_not_stop_it(tmp_path):
    (tmp_path / "log").write_bytes(b"\xff\xfe\nb\n")
    assert list(Tail(tmp_path / "log", None).new_lines()) == ["��", "b"]


def test_logs_are_merged_by_time_and_lines_without_one_stay_in_place():
    manager = ["2026-01-01T00:00:01.000 INFO a", "2026-01-01T00:00:03.000 INFO c"]
    replica = ["2026-01-01T00:00:02.000 INFO b", "Traceback", "  of a service"]
    assert in_order({"manager": manager, "0.1": replica}) == [
        ("manager", manager[0]),
        ("0.1", replica[0]),
        ("0.1", "Traceback"),
        ("0.1", "  of a service"),
        ("manager", manager[1]),
    ]


def test_a_nodes_own_lines_have_its_clock_and_what_was_cut_off_before_them_goes_with_them():
    node = ["  of a service", "[INFO] [1767225602.500000000] [planner]: b"]
    manager = ["2026-01-01T00:00:01.000 INFO a", "2026-01-01T00:00:03.000 INFO c"]
    merged = [line for _, line in in_order({"0.1": node, "manager": manager})]
    assert merged == [manager[0], *node, manager[1]]
