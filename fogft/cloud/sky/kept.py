"""Answers that are kept for a while, and renewed elsewhere before they are too old."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from fogft.errors import CloudError, SpecError

T = TypeVar("T")


@dataclass
class Kept(Generic[T]):
    """The answer to `ask`: asked anew by `submit` after `fresh_s`, waited for after `usable_s`."""

    ask: Callable[[], T]
    fresh_s: float
    usable_s: float
    clock: Callable[[], float]
    submit: Callable[[Callable[[], None]], object]
    failed: Callable[[CloudError | SpecError], None]  # hears why it was not renewed elsewhere
    answer: T | None = field(default=None, init=False)  # None: there was none yet
    _at: float = field(default=-math.inf, init=False)
    _forgotten: int = field(default=0, init=False)  # how often
    _renewing: bool = field(default=False, init=False)

    def get(self) -> T:
        """Return the answer."""
        age_s = self.clock() - self._at
        if self.answer is None or not 0 <= age_s < self.usable_s:  # a clock may be set back
            return self.renew()
        if age_s >= self.fresh_s and not self._renewing:
            self._renewing = True
            self.submit(self._renew_elsewhere)
        return self.answer

    def renew(self) -> T:
        """Ask now; return the answer."""
        begun_at, forgotten = self.clock(), self._forgotten
        answer = self.ask()
        # What was asked before it was to be forgotten is no newer for being answered after.
        self.answer = answer
        self._at = begun_at if forgotten == self._forgotten else -math.inf
        return answer

    def forget(self) -> None:
        """Ask the next time."""
        self._forgotten += 1
        self._at = -math.inf

    def _renew_elsewhere(self) -> None:
        try:
            self.renew()
        except (CloudError, SpecError) as error:
            self.failed(error)
        finally:
            self._renewing = False
