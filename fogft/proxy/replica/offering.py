"""The services that a replica offers: those in its configuration, or those of `run`.

If the configuration lists none, every service that an application offers in the replica's ROS
graph is offered, under its ROS name.
Not here: which of them the robot proxies (`fogft.pool.folder.discovered`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fogft.model.names import NAMES_BYTES_LIMIT
from fogft.model.spec import ServiceSpec
from fogft.model.type_definition import Definition
from fogft.ros.port import RosNode

LOOK_EVERY_S = 0.25
SETTLED_S = 1.0  # unchanged for this long: services that are starting are reported together
_TOLD = 8  # limit on names in a message


@dataclass(eq=False)
class Offering:
    """The services of one replica: those in the configuration, or those discovered."""

    services: tuple[ServiceSpec, ...]
    define: Callable[[str], Definition]
    clock: Callable[[], float]
    topic_types: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self._finds_out = not self.services
        self._definitions: dict[str, Definition] = {}
        self._seen: Mapping[str, str] = {}
        self._left_out = 0
        self._seen_since = self._looked_at = float("-inf")

    def look(self, node: RosNode, *, complete: bool) -> tuple[ServiceSpec, ...]:
        """Return newly discovered services. `complete`: all known services are ready."""
        now = self.clock()
        if complete and not self._finds_out:
            self._seen = {}
            return ()
        if now < self._looked_at + LOOK_EVERY_S:
            return ()
        self._looked_at = now
        offered = node.offered()
        seen = _that_fit(offered)
        self._left_out = len(offered) - len(seen)
        if seen != self._seen:
            self._seen, self._seen_since = seen, now
        if not self._finds_out:
            return ()
        known = {service.name for service in self.services}
        new = tuple(ServiceSpec(n, t) for n, t in sorted(seen.items()) if n not in known)
        self.services += new
        return new

    def reset(self) -> None:
        """Forget the services seen, because `run` has exited."""
        self._seen, self._seen_since = {}, self.clock()

    def told(self, ready: frozenset[str]) -> dict[str, str]:
        """Return name -> type of the services to report to robots, once stable; else nothing.

        That is all discovered ones, or the listed ones that `run` offers as another type.
        """
        if self.clock() < self._seen_since + SETTLED_S:
            return {}
        return dict(self._seen) if self._finds_out else self._mistyped(ready)

    def _mistyped(self, ready: frozenset[str]) -> dict[str, str]:
        missing = (one for one in self.services if one.name not in ready)
        offered = ((one, self._seen.get(one.name, one.type)) for one in missing)
        return {one.name: found for one, found in offered if found != one.type}

    def types(self) -> dict[str, Definition]:
        """Return the definitions of all types here; empty until each is known."""
        for type_name in (*(service.type for service in self.services), *self.topic_types):
            found = self._definitions.get(type_name)
            if found is None or not found.known:
                self._definitions[type_name] = self.define(type_name)
        told = dict(self._definitions)
        return told if all(definition.known for definition in told.values()) else {}

    def missing(self, ready: frozenset[str]) -> str:
        """Say which services are missing and what `run` offers instead; empty if complete."""
        if self._finds_out and not self.services:
            return "`run` offers no service yet"
        missing = sorted({service.name for service in self.services} - ready)
        if not missing:
            what = f"{self._left_out} services of `run` are left out: names and types may have"
            limit = f"{NAMES_BYTES_LIMIT} bytes in total"
            return f"{what} {limit}" if self._left_out and self._finds_out else ""
        listed = {service.name: service.type for service in self.services}
        for name, offered in self._mistyped(ready).items():
            return f"`run` offers {name} as {offered}, not as {listed[name]}"
        there = [name for name in missing if name in self._seen]
        # Discovery lists a service before it can be called.
        if there and self.clock() >= self._seen_since + SETTLED_S:
            return f"`run` offers {there[0]}, but it cannot be called: has it another QoS?"
        others = [f"{n} ({t})" for n, t in sorted(self._seen.items()) if listed.get(n) != t]
        more = "; it offers " + ", ".join(others[:_TOLD]) if others else ""
        if len(others) > _TOLD:
            more += f" and {len(others) - _TOLD} more"
        return f"`run` does not offer {', '.join(missing)} yet{more}"


def _that_fit(offered: Mapping[str, str]) -> dict[str, str]:
    """Return as many services, in order of name, as fit into a probe's answer."""
    room, found = NAMES_BYTES_LIMIT, dict[str, str]()
    for name, kind in sorted(offered.items()):
        room -= len(name) + len(kind)
        if room < 0:
            break
        found[name] = kind
    return found
