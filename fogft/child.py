"""Start a program that cannot outlive the process that started it."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

# Asks the kernel for the signal, then becomes the program. A program of its own and not a
# `preexec_fn`, which is unsafe in a process with threads. 1 is PR_SET_PDEATHSIG.
_PROGRAM = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, int(signal.SIGKILL), 0, 0, 0)
if os.getppid() != int(sys.argv[1]):
    sys.exit("the parent died before its child began")
os.execvp(sys.argv[2], sys.argv[2:])
"""


def tied(command: Sequence[str]) -> list[str]:
    """Return a command that gets SIGKILL when this process ends, whatever ends it.

    The kernel ties the child to the *thread* that starts it: start it from one that lives
    as long as the process does, the main thread.
    """
    return [sys.executable, "-IS", "-c", _PROGRAM, str(os.getpid()), *command]
