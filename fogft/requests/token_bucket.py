"""A budget for extra copies: a share of what was asked for, and a little to begin with. Pure.

Tokens come with requests, not with time: a service that is asked once a minute and one that is
asked a thousand times a second both send the same share of extra copies.

Law: after n requests at most ``capacity + share * n`` copies were taken.
"""

from __future__ import annotations


class TokenBucket:
    """Tokens for extra copies.

    Args:
        share: Tokens that each request brings, above 0 and at most 1.
        capacity: The most that are kept, and how many there are at first.
    """

    def __init__(self, share: float, capacity: float) -> None:
        self._share = share
        self._capacity = capacity
        self._tokens = capacity

    @property
    def tokens(self) -> float:
        """What is there now."""
        return self._tokens

    def request(self) -> None:
        """Count a request."""
        self._tokens = min(self._capacity, self._tokens + self._share)

    def take(self, *, leave: float = 0.0) -> bool:
        """Take a token, if then at least `leave` are left."""
        if self._tokens < 1.0 + leave:
            return False
        self._tokens -= 1.0
        return True
