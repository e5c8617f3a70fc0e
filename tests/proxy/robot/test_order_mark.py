"""The mark's file: what is written is there after SIGKILL, and nothing foreign is taken."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from fogft.errors import StateError
from fogft.ordering.orders import START, Position
from fogft.proxy.robot.order_mark import OrderMark

UID = "0123456789abcdef"


def test_a_new_mark_is_the_start_and_terms_only_grow(tmp_path):
    mark = OrderMark(tmp_path / "marks" / "m", UID)
    assert mark.position == START
    first, second = mark.new_term(7), mark.new_term(3)
    third = mark.new_term(0, above=second + (9 << 32))
    assert 0 < first < second < third
    mark.close()
    assert OrderMark(tmp_path / "marks" / "m", UID).new_term(1) > third


def test_what_was_written_survives_sigkill(tmp_path):
    """The process writes, says so, and is killed without a chance to flush anything."""
    program = (
        "import sys; from pathlib import Path\n"
        "from fogft.ordering.orders import Position\n"
        "from fogft.proxy.robot.order_mark import OrderMark\n"
        f"mark = OrderMark(Path(sys.argv[1]), '{UID}')\nepoch = mark.new_term(5)\n"
        "for i in range(1000): mark.write(Position(epoch, i))\n"
        "print(epoch, flush=True)\nimport signal; signal.pause()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path / "m")], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    epoch = int(process.stdout.readline())
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    mark = OrderMark(tmp_path / "m", UID)
    assert mark.position == Position(epoch, 999)
    assert mark.new_term(5) > epoch


@pytest.mark.parametrize("content", [b"", b"x" * 40, b"short"])
def test_a_foreign_or_damaged_file_is_refused(tmp_path, content):
    (tmp_path / "m").write_bytes(content)
    with pytest.raises(StateError, match="m`"):
        OrderMark(tmp_path / "m", UID)


def test_the_mark_of_another_pool_is_refused(tmp_path):
    OrderMark(tmp_path / "m", UID).close()
    with pytest.raises(StateError, match="not the order mark of this pool"):
        OrderMark(tmp_path / "m", "f" * 16)
