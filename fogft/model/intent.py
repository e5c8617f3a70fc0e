"""The user's changes besides the pool file: scale, drain, exclude, down. Pure.

The command line writes the intent that an operation returns; the manager reads it.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from fogft.errors import FogftError
from fogft.model.choices import MAX_REPLICAS
from fogft.model.plain import Count, Moment
from fogft.model.schedule import wish
from fogft.model.spec import PoolSpec

LOCATION = re.compile(r"[\w.-]+(/[\w.-]+){0,2}")


@dataclass(frozen=True)
class Intent:
    """The user's changes to a pool.

    `target` applies while the file's `replicas` equals `scaled_from`; otherwise the file decides.
    """

    target: Count | None = None  # number set by `fogft scale`; None if the pool file decides
    scaled_from: Count | None = None
    drained: Mapping[int, int] = field(default_factory=dict)  # slot -> last generation to replace
    excluded: frozenset[str] = frozenset()  # ``cloud``, ``cloud/region`` or all three
    stopping: bool = False
    began_at: Moment = 0.0  # when `max_hours` was restarted; 0: it counts from the pool's creation
    retried_at: Moment = 0.0

    def wanted(self, spec: PoolSpec, now: float) -> int:
        """Return the number of replicas set by the user or the file; see `sizing` for its use."""
        if self.stopping:
            return 0
        if self.target is not None and self.is_scaled(spec):
            return self.target
        return wish(spec, now).replicas

    def is_scaled(self, spec: PoolSpec) -> bool:
        """Whether the user's number of replicas overrides the file's."""
        return self.target is not None and self.scaled_from == spec.replicas

    def is_excluded(self, location: str) -> bool:
        """Whether a ``cloud/region/zone`` lies in an excluded location."""
        return any((location + "/").startswith(place + "/") for place in self.excluded)


def scale(intent: Intent, spec: PoolSpec, change: int, now: float) -> Intent:
    """Change the number of replicas by `change`; at the file's own number, `target` is cleared."""
    if spec.availability is not None:
        raise FogftError(
            f"`{spec.name}` cannot be scaled: `availability` sets its number of replicas",
            "change `fogft.availability` or `fogft.replicas` in the pool file and run `fogft up`",
        )
    wanted = intent.wanted(spec, now) + change
    least = max((1, *(service.quorum for service in spec.services)))
    cannot = f"cannot scale `{spec.name}` to {wanted} replicas"
    if wanted > MAX_REPLICAS:
        raise FogftError(f"{cannot}: the maximum is {MAX_REPLICAS}")
    if wanted < least:
        raise FogftError(
            f"{cannot}: the minimum is {least}",
            "`fogft down` ends a pool"
            if least == 1
            else "a service needs that `quorum`: change it in the pool file and run `fogft up`",
        )
    if wanted == wish(spec, now).replicas:
        return replace(intent, target=None, scaled_from=None)
    return replace(intent, target=wanted, scaled_from=spec.replicas)


def drain(intent: Intent, slot: int, generation: int) -> Intent:
    """Replace the replica in a slot, up to this generation. Repeating it changes nothing."""
    latest = max(generation, intent.drained.get(slot, 0))
    return replace(intent, drained={**intent.drained, slot: latest})


def exclude(intent: Intent, location: str) -> Intent:
    """Exclude a location. Repeatable."""
    return replace(intent, excluded=intent.excluded | {checked_location(location)})


def include(intent: Intent, location: str) -> Intent:
    """Allow a location again. Repeatable."""
    place = checked_location(location)
    if place not in intent.excluded:
        listed = ", ".join(f"`{p}`" for p in sorted(intent.excluded)) or "nothing"
        raise FogftError(f"`{place}` is not excluded", f"excluded now: {listed}")
    return replace(intent, excluded=intent.excluded - {place})


def retry(intent: Intent, now: float) -> Intent:
    """Resume launching a pool file that was given up, or reached the hourly limit."""
    return replace(intent, retried_at=now)


def file_changed(intent: Intent, before: PoolSpec, after: PoolSpec) -> Intent:
    """Apply a new pool file: a changed `replicas` overrides an earlier `scale`."""
    if before.replicas != after.replicas:
        intent = replace(intent, target=None, scaled_from=None)
    return replace(intent, stopping=False)


def checked_location(text: str) -> str:
    """Return a location without surrounding slashes."""
    place = text.strip().strip("/")
    if not LOCATION.fullmatch(place):
        raise FogftError(
            f"`{text}` is not a location", "write `cloud`, `cloud/region` or `cloud/region/zone`"
        )
    return place
