"""Mistakes in a pool file: the first ends the reading, or all are found. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from fogft.errors import SpecError


class Incomplete(Exception):
    """A value cannot be made, for something in it is wrong."""


class Mistakes:
    """What is wrong in a file; with `keep` the reading goes on after each."""

    def __init__(self, *, keep: bool = False) -> None:
        self._keep = keep
        self.found: list[SpecError] = []

    @contextmanager
    def step(self) -> Iterator[None]:
        """Judge something that does not depend on other steps."""
        try:
            yield
        except SpecError as error:
            if not self._keep:
                raise
            self.found.append(error)
        except Incomplete:
            pass

    def add(self, errors: Iterable[SpecError]) -> None:
        """Take mistakes one by one: the first is raised unless all are kept."""
        for error in errors:
            with self.step():
                raise error

    @contextmanager
    def whole(self) -> Iterator[None]:
        """Judge all parts of one value; where one is wrong there is no value.

        Raises:
            Incomplete: Something was found within.
        """
        before = len(self.found)
        yield
        if len(self.found) > before:
            raise Incomplete
