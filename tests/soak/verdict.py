"""Whether a soak passed, and if not, why. Pure."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Outcome:
    """What a soak came to.

    Attributes:
        asked: Requests of all robots.
        right: Those with their own answer, once.
        wrong: Numbers of answers that were another's, or came twice.
        silent: Requests without an answer by their deadline, or turned away.
        twice: What one server proxy ran more than once, in words.
        ran: How many different requests the server proxies noted.
        done: Fault -> how often it was done.
        trouble: What came to an end before its time, in words.
    """

    asked: int
    right: int
    wrong: Sequence[int]
    silent: int
    twice: Sequence[str]
    ran: int
    done: Mapping[str, int]
    trouble: str = ""

    @property
    def failed(self) -> int:
        """Requests without any answer."""
        return self.asked - self.right - len(self.wrong)

    @property
    def unseen(self) -> int:
        """Requests that were answered and run by nobody: then what ran twice is not known."""
        return max(0, self.right - self.ran)


def faults_found(outcome: Outcome, kinds: Collection[str]) -> list[str]:
    """Return why a soak has not passed; nothing if it has.

    Args:
        outcome: What it came to.
        kinds: The faults that had to be done.
    """
    missing = sorted(kind for kind in kinds if not outcome.done.get(kind))
    found = {
        "no request was asked": not outcome.asked,
        f"failed: {outcome.failed}": outcome.failed,
        f"wrong: {list(outcome.wrong)[:10]}": outcome.wrong,
        f"unanswered in time: {outcome.silent}": outcome.silent,
        f"run twice: {list(outcome.twice)[:10]}": outcome.twice,
        f"answered and noted by no server proxy: {outcome.unseen}": outcome.unseen,
        f"never done: {', '.join(missing)}": missing,
        outcome.trouble: outcome.trouble,
    }
    return [why for why, is_so in found.items() if is_so]
