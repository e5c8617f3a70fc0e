"""Tests that `test_own_process` runs, some in processes of their own; nobody else collects them."""

from __future__ import annotations

import os

import pytest

NOTED = "FOGFT_TEST_NOTES"


def note(name: str) -> None:
    with open(os.environ[NOTED], "a") as notes:
        notes.write(f"{name} {os.getpid()}\n")


def test_here() -> None:
    note("here")


@pytest.mark.own_process
@pytest.mark.parametrize("number", [1, 2])
def test_there(number: int) -> None:
    note("there")


@pytest.mark.own_process
def test_broken() -> None:
    pytest.fail("as it should")


@pytest.mark.own_process
def test_skipped() -> None:
    pytest.skip("for no reason")
