"""The result of a check, with a remedy."""

from collections.abc import Callable, Iterable, Iterator
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from fogft.model.spec import PoolSpec


class Verdict(str, Enum):
    """How serious a finding is."""

    OK = "ok"
    WARN = "warn"  # works, but may cause trouble
    FAIL = "fail"  # does not work


class Finding(NamedTuple):
    """The result of one check."""

    check: str
    verdict: Verdict
    text: str
    advice: str = ""


class Situation(NamedTuple):
    """The input of all checks."""

    home: Path
    pools: tuple[str, ...] = ()
    spec: PoolSpec | None = None
    now: float = 0.0


Check = Callable[[Situation], Iterable[Finding]]


def ok(check: str, text: str) -> Finding:
    """Return a finding without a problem."""
    return Finding(check, Verdict.OK, text)


def warn(check: str, text: str, advice: str) -> Finding:
    """Return a finding that may cause trouble, with advice."""
    return Finding(check, Verdict.WARN, text, advice)


def fail(check: str, text: str, advice: str) -> Finding:
    """Return a finding that stops a pool from working, with advice."""
    return Finding(check, Verdict.FAIL, text, advice)


def run(check: Check, situation: Situation) -> Iterator[Finding]:
    """Run a check and yield its findings as they come, even if the check itself crashes."""
    try:
        yield from check(situation)
    except Exception as error:
        what = f"the check itself failed: {type(error).__name__}: {error}"
        advice = "report this as a bug, unless processes, files or memory ran out (`ulimit -a`)"
        yield fail(check.__name__.replace("_", " "), what, advice)
