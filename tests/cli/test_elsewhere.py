"""On macOS and Windows files can be written, checked, planned, simulated; the rest says Linux.

And what is loaded anywhere, and when: a command line starts at once.
"""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

# As there: another name of the platform, and no module that only Unix has. What is of the standard
# library, or uses it, is loaded before it could take this for another machine.
PRETEND = """
import asyncio, ctypes, concurrent.futures, contextlib, io, json, logging, multiprocessing, random
import shutil, socket, sqlite3, ssl, subprocess, tempfile, urllib.request, uuid, zoneinfo
import rich.console, typer, yaml
import sys
sys.platform = {platform!r}
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in {missing!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
for name in {missing!r}:
    sys.modules.pop(name, None)
if sys.platform == "win32":
    import select
    for name in [name for name in vars(select) if name.lower().startswith(("poll", "epoll"))]:
        delattr(select, name)
from fogft.cli import main
for words in {commands!r}:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main.run(words)
    print(json.dumps([status, out.getvalue(), err.getvalue()]))
"""
UNIX_ONLY = {
    "win32": ["fcntl", "grp", "pwd", "resource", "termios", "rclpy", "zenoh"],
    "darwin": ["rclpy"],
}
WORKS = [
    ["--help"],
    ["init", "planner", "--into", "."],
    ["plan", "--offline", "pool.yaml"],
    ["simulate", "pool.yaml", "--days", "0.1", "--seeds", "1"],
    ["check", "pool.yaml"],
]
NEEDS_LINUX = [["up", "pool.yaml"], ["status", "--json"], ["serve", "--help"], ["scale", "up", "1"]]


@pytest.mark.parametrize("platform", UNIX_ONLY)
def test_files_can_be_judged_and_the_rest_is_one_error_that_says_linux(platform, tmp_path):
    program = PRETEND.format(
        platform=platform, missing=UNIX_ONLY[platform], commands=WORKS + NEEDS_LINUX
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    ends = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(ends) == len(WORKS + NEEDS_LINUX), done.stderr
    works, rest = ends[: len(WORKS)], ends[len(WORKS) :]
    assert [status for status, _, _ in works[:-1]] == [0] * (len(WORKS) - 1), works
    status, found, _ = works[-1]
    assert status == 0 or "ROS 2" in found, "without ROS 2 the types cannot be looked up"
    for (status, _, told), words in zip(rest, NEEDS_LINUX, strict=True):
        error = f"error: `fogft {words[0]}` needs Linux; this is {platform}\n\nhint: "
        assert (status, told[: len(error)]) == (1, error)


HEAVY = {"zenoh", "sky", "rclpy", "cryptography", "boto3", "numpy", "rich", "yaml"}


def loaded(code: str) -> set[str]:
    """Run code in a fresh Python; return the top-level modules that it loaded."""
    report = "import sys, json; print(); print(json.dumps([m.split('.')[0] for m in sys.modules]))"
    ended = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True
    )
    return set(json.loads(ended.stdout.splitlines()[-1]))


@pytest.mark.parametrize(
    "code",
    [
        "import fogft",
        "import fogft.pool.commands.composition",
        "import fogft.cli.main",
        "from fogft.cli import main; assert main.run(['--help']) == 0",
        "from fogft.cli import main; assert main.run(['up', '--help']) == 0",
        "from fogft.cli import main; assert main.run(['--version']) == 0",
    ],
)
def test_nothing_heavy_is_loaded(code):
    assert loaded(code) & HEAVY == set()
