"""What a proof needs of the emulated AWS: to look at it, to break it, and to time its steps."""

from __future__ import annotations

import json
import os
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

CONTROL = os.environ.get("EMULATED_AWS", "")
IMAGE = Path(os.environ.get("EMULATION", "/nowhere"))


def control(path: str, *, post: bool = True) -> Any:
    """Ask the emulation for something; see `aws.py` for what there is."""
    request = urllib.request.Request(CONTROL + path, method="POST" if post else "GET")
    return json.load(urllib.request.urlopen(request, timeout=30))


def running() -> list[dict[str, Any]]:
    """Return the instances that run, of all regions."""
    return [i for i in control("/instances", post=False) if i["state"] == "running"]


def disk_of(instance: dict[str, Any]) -> Path:
    """Return where all lies that a VM has written since it booted."""
    return IMAGE / "vm" / f"f{instance['id'][-8:]}" / "upper"


def until(what: str, is_so: Callable[[], Any], limit_s: float = 900.0) -> Any:
    """Wait until something is so; return what it gave."""
    pause, end = threading.Event(), time.monotonic() + limit_s
    while time.monotonic() < end:
        found = is_so()
        if found:
            return found
        pause.wait(0.25)
    raise AssertionError(f"not within {limit_s:.0f} s: {what}")


@dataclass
class Steps:
    """Times the steps of a proof, and says each as it ends."""

    done: list[tuple[str, float, float]] = field(default_factory=list)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time one step: its name, and when it began and ended in seconds since the epoch."""
        begun_at = time.time()
        yield
        self.done.append((name, begun_at, time.time()))
        print(f"{self.done[-1][2] - begun_at:7.1f} s  {name}", flush=True)

    def write(self, name: str) -> None:
        """Write the table of steps to a file in the folder $RESULTS."""
        table = "".join(f"{end - begin:7.1f} s  {step}\n" for step, begin, end in self.done)
        Path(os.environ["RESULTS"], f"{name}.txt").write_text(table)
