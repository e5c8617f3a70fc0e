"""What replicas must have besides single requests: goals, cancellations, an order of requests.

Owns: the interface. Implemented for actions (`actions`) and stateful services (`service_order`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple, Protocol


class Send(NamedTuple):
    """Something to be sent to a replica.

    Attributes:
        id: Of the attempt.
        timeout_s: How long it is good for.
        is_copy: It is a copy of a caller's request, and counted as one.
    """

    replica: int
    id: bytes
    payload: bytes
    timeout_s: float
    is_copy: bool = False


class Replication(Protocol):
    """Brings replicas to what they must have. Called under the dispatcher's lock.

    Attributes:
        sends_requests: Requests leave by `take` too, in its order, and are not chosen for.
    """

    sends_requests: bool

    @property
    def ready(self) -> bool:
        """Whether a request that is taken now can be answered."""

    def request_of(self, id: bytes) -> bytes | None:
        """Return the request that an attempt is about; None for one that is about none."""

    def reach(
        self,
        come: Collection[int],
        now: float,
        versions: Mapping[int, str],
        leaving: Collection[int],
    ) -> None:
        """Note which replicas can be sent to.

        Args:
            come: Those that could not be before.
            now: Seconds.
            versions: All of them, and what each runs.
            leaving: Those that are to go soon.
        """

    def take(self, now: float, timeout_s: float) -> Sequence[Send]:
        """Return what is to be sent now, in this order.

        Args:
            now: Seconds.
            timeout_s: Of the service's requests.
        """

    def declined(self, id: bytes, replica: int, now: float) -> None:
        """A replica's link did not take an attempt."""

    def close(self) -> None:
        """The service is not proxied any more."""
