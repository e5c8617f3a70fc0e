"""At the end of the process, threads that are about to end are waited for."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

CODE = """
import sys, threading, time
from fogft.link.zenoh import threads as leaving

def leave(seconds):
    time.sleep(seconds)
    print("left", flush=True)

thread = threading.Thread(target=leave, args=(float(sys.argv[1]),), daemon=True)
thread.start()
leaving.WAIT_S = float(sys.argv[2])
leaving.join_at_exit(thread)
"""


def _left(needs_s: float, wait_s: float) -> bool:
    ended = subprocess.run(
        [sys.executable, "-c", CODE, str(needs_s), str(wait_s)],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        check=True,
        timeout=100,
    )
    return ended.stdout == "left\n"


def test_a_thread_that_is_about_to_end_is_waited_for() -> None:
    """The interpreter would end it where it is, though it is a daemon."""
    assert _left(0.3, wait_s=60.0)


def test_a_thread_that_takes_too_long_is_not_waited_for() -> None:
    """A frozen peer does not keep the process from ending."""
    assert not _left(3600.0, wait_s=0.1)
