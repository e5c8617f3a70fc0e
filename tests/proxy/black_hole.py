"""A rendezvous in a black hole for a while, under load, and a replica that joins meanwhile.

```
 manager, robot, replicas ══ router ══ rendezvous       (or a relay on loopback, without root)
```

``python -m tests.proxy.black_hole --seconds 120`` as root lets nothing pass the router either way
for two minutes, and tells nobody. Requests go on all the time. A second replica starts in the dark;
it prints when the robot knew of it and had its answer, counted from the moment that packets pass.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogft.model.replica import Member, Membership, ReplicaId
from fogft.records.record import RecordKind
from fogft.records.roster import admission_content
from tests.fakes.waiting import paced
from tests.link.namespaces import Namespaces, inside
from tests.link.thin_relay import ThinRelay
from tests.link.wire_pool import POOL_UID, Authority, wait_for
from tests.proxy.gateway_pool import GatewayPool, Robot, ServerProxy
from tests.records.rendezvous_pool import Party, Rendezvous, manager_files

LIMIT_S = 90.0
PLACE, NEAR, REST, FAR = "10.79.1.1", "10.79.1.2", "10.79.2.1", "10.79.2.2"


@dataclass
class Way:
    """How the rendezvous is reached, and how that ends and begins again."""

    rendezvous: Rendezvous
    endpoint: str
    cut: Callable[[], None]
    restore: Callable[[], None]


@contextlib.contextmanager
def by_router(authority: Authority) -> Iterator[Way]:
    """Have a router between the rendezvous and the rest; this thread lives with the rest."""
    net = Namespaces()
    try:
        place, router, rest = (net.add(name) for name in ("place", "router", "rest"))
        net.forward(router)
        near, _ = net.join(place, PLACE, router, NEAR)
        far, _ = net.join(rest, REST, router, FAR)
        net.route(place, REST, NEAR, near, metric=1)
        net.route(rest, PLACE, FAR, far, metric=1)
        with inside(place):
            rendezvous = Rendezvous(authority, "a", endpoint=f"{PLACE}:7450")

        def every(change: Callable[[str, str], None]) -> None:
            for address in (PLACE, REST):
                change(router, address)

        try:
            with inside(rest):
                yield Way(
                    rendezvous,
                    rendezvous.endpoint,
                    lambda: every(net.blackhole),
                    lambda: every(net.restore),
                )
        finally:
            rendezvous.kill()
    finally:
        net.close()


@contextlib.contextmanager
def by_relay(authority: Authority) -> Iterator[Way]:
    """Have a relay on loopback before the rendezvous: connections open, and nothing passes."""
    rendezvous = Rendezvous(authority, "a")
    relay = ThinRelay(rendezvous.endpoint)
    try:
        yield Way(rendezvous, relay.endpoint, relay.open.clear, relay.open.set)
    finally:
        relay.open.set()
        relay.close()
        rendezvous.kill()


WAYS = {"router": by_router, "relay": by_relay}


def run(folder: Path, way: str, seconds: float) -> dict[str, Any]:
    """Run once; return what was seen.

    Raises:
        AssertionError: A request failed or was answered wrongly, or the robot did not hear of
            what joined within `LIMIT_S`.
    """
    pool = GatewayPool(folder, timeout_s=60.0)
    replicas: list[ServerProxy] = []
    with WAYS[way](pool.authority) as way_there, contextlib.ExitStack() as stack:
        stack.callback(lambda: [replica.kill() for replica in replicas])
        stack.callback(pool.close)

        def meeting(stem: str) -> str:
            return f"rendezvous: ['{way_there.endpoint}']\nrecords: {stem}-records.json\n"

        def join(slot: int) -> None:
            replica = ServerProxy(pool, slot, meeting(f"r{slot}"))
            replicas.append(replica)
            slots = range(slot + 1)
            members = tuple(Member(ReplicaId(POOL_UID, s, 1), "") for s in slots)
            content = admission_content(Membership("p", POOL_UID, 2, slot + 1, members))
            manager.client.publish(RecordKind.ADMISSION, "", 2, content, sequence=slot + 1)

        manager = Party(manager_files(pool.authority), way_there.endpoint)
        stack.callback(manager.client.close)
        join(0)
        robot = pool.robot("ada", extra=meeting("ada"))
        wait_for(robot.ready, LIMIT_S)
        way_there.cut()
        cut = time.monotonic()
        _load_until(robot, lambda: not _connected(robot) and not manager.client.known.connected)
        noticed_s = time.monotonic() - cut
        join(1)
        _load_until(robot, lambda: time.monotonic() - cut >= seconds)
        asked = robot.tell()["asked"]
        assert _slots(robot) == {0}
        way_there.restore()
        back = time.monotonic()
        _load_until(robot, lambda: 1 in _slots(robot))
        known_s = time.monotonic() - back
        _load_until(robot, lambda: robot.ready(2))
        ready_s = time.monotonic() - back
        robot.all_right()
        told = robot.tell()
        return {
            "way": way,
            "dark_s": round(back - cut, 1),
            "noticed_after_s": round(noticed_s, 2),
            "asked_in_the_dark": asked,
            "asked": told["asked"],
            "answered_rightly": told["right"],
            "known_after_s": round(known_s, 3),
            "ready_after_s": round(ready_s, 3),
        }


def _connected(robot: Robot) -> bool:
    return any(one["connected"] for one in robot.tell()["report"]["records"]["rendezvous"])


def _slots(robot: Robot) -> set[int]:
    return {link["slot"] for link in robot.tell()["report"]["links"]}


def _load_until(robot: Robot, condition: Callable[[], object]) -> None:
    """Ask all the time until a condition holds; each answer is checked at the end."""
    for _ in paced(0.02, seconds=LIMIT_S + 600):
        if condition():
            return
        robot.ask(2)
    raise AssertionError("what was awaited under load never came")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--way", choices=sorted(WAYS), default="router")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(run(Path(folder), given.way, given.seconds), indent=1))


if __name__ == "__main__":
    main()
