"""A cached answer that is renewed in the background before it is too old."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from fogft.errors import CloudError, SpecError

T = TypeVar("T")


@dataclass
class Kept(Generic[T]):
    """Caches `ask()`: renews it through `submit` after `fresh_s`, waits for it after `usable_s`."""

    ask: Callable[[], T]
    fresh_s: float
    usable_s: float
    clock: Callable[[], float]
    submit: Callable[[Callable[[], None]], object]
    failed: Callable[[CloudError | SpecError], None]  # told why a renewal through `submit` failed
    answer: T | None = field(default=None, init=False)  # None: there was none yet
    _at: float = field(default=-math.inf, init=False)
    _forgotten: int = field(default=0, init=False)  # how many times `forget` was called
    _renewing: bool = field(default=False, init=False)

    def get(self) -> T:
        """Return the cached answer, or ask if there is none or it is too old."""
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
        # An answer requested before `forget` is stale, even if it arrives afterwards.
        self.answer = answer
        self._at = begun_at if forgotten == self._forgotten else -math.inf
        self._renewing = False  # also after a `submit` that failed
        return answer

    def forget(self) -> None:
        """Make the next `get` ask again."""
        self._forgotten += 1
        self._at = -math.inf

    def _renew_elsewhere(self) -> None:
        try:
            self.renew()
        except (CloudError, SpecError) as error:
            self.failed(error)
        finally:
            self._renewing = False
