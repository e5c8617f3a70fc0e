"""What the shell offers after a Tab, asked as the shells ask."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import pytest

from fogft.cli import options
from tests.fakes.pools import STATUS, lay_down


def offered(*words: str) -> list[str]:
    """Return what bash would offer for a command line whose last word is incomplete."""
    ended = subprocess.run(
        [sys.executable, "-m", "fogft"],
        env={
            **os.environ,
            "_FOGFT_COMPLETE": "complete_bash",
            "COMP_WORDS": " ".join(("fogft", *words)),
            "COMP_CWORD": str(len(words)),
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.stderr == ""
    return ended.stdout.split()


def test_commands_complete():
    assert offered("st") == ["status"]
    assert offered("chaos", "bl") == ["blackhole"]


def test_pools_and_slots_complete(home):
    lay_down(home)
    lay_down(home, replace(STATUS, pool="detector"))
    assert offered("status", "") == ["detector", "planner"]
    assert offered("down", "pl") == ["planner"]
    assert offered("drain", "") == ["0", "1", "2"]
    assert offered("drain", "0", "--pool", "d") == ["detector"]


def test_locations_and_examples_complete(home):
    lay_down(home)
    assert offered("exclude", "local/e") == ["local/eu-central-1", "local/eu-central-1/b"]
    assert "planner" in offered("init", "")


def test_what_cannot_be_known_is_not_offered(home):
    """A damaged pool must not print an error into somebody's command line."""
    paths = lay_down(home)
    paths.status.write_text("{")
    paths.intent.write_text("{")
    assert offered("drain", "") == []
    assert options.excluded("") == []


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_scripts_for_shells(shell):
    ended = subprocess.run(
        [sys.executable, "-m", "fogft"],
        env={**os.environ, "_FOGFT_COMPLETE": f"source_{shell}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "_FOGFT_COMPLETE" in ended.stdout or "_fogft_completion" in ended.stdout
