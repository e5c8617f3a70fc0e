"""A pool to be damaged: replicas behind relays, two gateways, a rendezvous, two robots.

```
 ada ══ two uplinks (in namespaces) ══► relay 0..2 ─► replica 0..2     rendezvous
 bob ──► gateway one, two ────────────► (the same)                     (tells where replicas are)
```

Replicas are admitted by the membership file and found by their own records, as on clouds where
unknown an address beforehand. No ROS: robots' callers and the service are stand-ins; all
else is the real thing.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from fogft.child import tied
from fogft.model.replica import Member, ReplicaId
from tests.fakes.waiting import wait_for
from tests.link.namespaces import Namespaces, inside
from tests.link.thin_relay import ThinRelay
from tests.link.wire_pool import POOL_UID
from tests.ports import free_port
from tests.proxy.gateway_pool import GatewayPool, Robot, ran, start_server
from tests.records import certificate_names
from tests.records.rendezvous_pool import Rendezvous
from tests.soak.clocks import Clocks, can_set

ADDRESS = "10.82.9.9"
REPLICAS = 3
LIMIT_S = 120.0  # for whatever has to come about on a machine that is busy
SECOND_ROBOT = 1 << 40  # its first request's number


class Cables:
    """A robot with two ways to everybody else, in namespaces of the run's own."""

    def __init__(self) -> None:
        self.made = Namespaces()
        self.robot, self.rest = self.made.add("robot"), self.made.add("rest")
        self.interfaces = []
        self._last = [1, 1]  # number of the robot's address on each cable
        for number in (1, 2):
            near, _ = self.made.join(
                self.robot, f"10.82.{number}.1", self.rest, f"10.82.{number}.2"
            )
            self.made.route(self.robot, ADDRESS, f"10.82.{number}.2", near, metric=number)
            self.interfaces.append(near)
        self.made.address(self.rest, ADDRESS)

    def stall(self, number: int) -> None:
        """Let nothing come back on a cable; nobody is told."""
        self.made.blackhole(self.rest, f"10.82.{number + 1}.{self._last[number]}")

    def readdress(self, number: int) -> None:
        """Give the robot's end of a cable another address."""
        old, new = self._last[number], 1 if self._last[number] > 1 else 77
        self._last[number] = new
        base, cable = f"10.82.{number + 1}", self.interfaces[number]
        self.made.readdress(self.robot, cable, f"{base}.{old}", f"{base}.{new}")
        self.made.route(self.robot, ADDRESS, f"{base}.2", cable, metric=number + 1)

    def heal(self, number: int) -> None:
        self.made.restore(self.rest, f"10.82.{number + 1}.{self._last[number]}")


class Replica:
    """A server proxy and the relay before it."""

    def __init__(self, world: World, slot: int, generation: int) -> None:
        self.id = ReplicaId(POOL_UID, slot, generation)
        listen = f"127.0.0.1:{free_port()}"
        self.relay = ThinRelay(listen, host=world.host)
        extra = f"advertise: {self.relay.endpoint}\n{world.meeting(f'replica{slot}.{generation}')}"
        self.process = start_server(
            world.folder, world.authority, self.id, listen, world.delays_s[slot], extra
        )

    def end(self, number: int = signal.SIGKILL) -> None:
        self.process.send_signal(number)
        self.process.wait(LIMIT_S)
        self.relay.close()


class World(GatewayPool):
    """The status of a pool. To be made, changed and closed by the main thread.

    Args:
        folder: For everything that is written.
        cables: Between ada and the rest; None for loopback, without uplinks.
        uplinks: The policy of ada's uplinks.
    """

    def __init__(self, folder: Path, cables: Cables | None, uplinks: str) -> None:
        super().__init__(folder, timeout_s=180.0, services=f", uplink_policy: {uplinks}")
        self.clocks = Clocks(folder) if can_set() else None
        self.host = ADDRESS if cables is not None else "127.0.0.1"
        self.delays_s = (0.002, 0.01, 0.02)
        self.cables = cables
        at = f"{self.host}:{free_port(self.host)}"
        self.rendezvous = Rendezvous(self.authority, "a", endpoint=at, prefix=tied([]))
        self.machines = [Replica(self, slot, 1) for slot in range(REPLICAS)]
        self._admit()
        self.gateways = {name: self.gateway(name, extra=self.meeting(name)) for name in "xy"}
        at_gateways = {name: (g.endpoint(), ()) for name, g in self.gateways.items()}
        self.lay_out(at_gateways, {"bob": tuple(self.gateways)})
        where, extra = "", self.meeting("ada")
        if cables is not None:
            where, extra = cables.robot, f"{extra}uplinks: [{', '.join(cables.interfaces)}]\n"
        self.robots: dict[str, Robot] = {
            "ada": self.robot("ada", where=where, extra=extra),
            "bob": self.robot("bob", extra=self.meeting("bob"), first=SECOND_ROBOT),
        }
        self.generations = {"ada": 1, "bob": 1}

    def meeting(self, stem: str) -> str:
        return f"rendezvous: ['{self.rendezvous.endpoint}']\nrecords: {stem}-records.json\n"

    def _admit(self) -> None:
        for machine in self.machines:
            self.members[machine.id.slot] = Member(machine.id, "")
        self.publish()

    # -- what can be done to it ---------------------------------------------------------------

    def relaunch(self, slot: int) -> None:
        """Start a replica anew, as the next generation at another address."""
        self.machines[slot] = Replica(self, slot, self.machines[slot].id.generation + 1)
        self._admit()

    def rotate(self, name: str) -> None:
        """Give a robot new credentials: the certificate comes last, as the real commands do it."""
        self.generations[name] += 1
        old, new = self.robots[name].files, self.authority.robot(name, self.generations[name])
        os.replace(new.key, old.key)
        os.replace(new.certificate, old.certificate)

    def pids(self) -> list[int]:
        """Return every process of it."""
        processes = [p.process for p in (*self.gateways.values(), *self.robots.values())]
        processes += [machine.process for machine in self.machines]
        assert self.rendezvous.process is not None
        return [process.pid for process in (*processes, self.rendezvous.process)]

    # -- what people would see ------------------------------------------------------------------

    def whole(self, name: str, report: Mapping[str, Any]) -> bool:
        """Whether a robot reports every replica ready, every way to them, and its present name."""
        wanted = {(m.id.slot, m.id.generation) for m in self.machines}
        seen = {(li["slot"], li["generation"]) for li in report["links"] if li["ready"]}
        own = certificate_names.robot(POOL_UID, name, self.generations[name])
        if seen != wanted or report["certificate"] != own:
            return False
        if name == "bob":
            return sum(bool(one["ready"]) for one in report["gateways"]) == len(self.gateways)
        return all(u["state"] == "up" for li in report["links"] for u in li.get("uplinks", ()))

    def wait_whole(self, report_of: Callable[[str], Mapping[str, Any]]) -> None:
        """Wait until both robots are whole, by what a function returns of each."""
        for name in self.robots:
            wait_for(
                lambda name=name: self.whole(name, report_of(name)),
                LIMIT_S,
                f"{name} whole again",
                told=lambda name=name: json.dumps(report_of(name)),
                pause_s=0.02,
            )

    def ran_twice(self) -> list[str]:
        """Return the requests that one server proxy ran more than once."""
        return [
            f"{name}: {number} {times} times"
            for name, counts in ran(self.folder).items()
            for number, times in counts.items()
            if times > 1
        ]

    def close(self) -> None:
        super().close()
        for machine in self.machines:
            with contextlib.suppress(subprocess.TimeoutExpired):
                machine.end()
        self.rendezvous.kill()


@contextlib.contextmanager
def made(folder: Path, *, namespaces: bool, uplinks: str) -> Iterator[World]:
    """Make a world; end it, whatever happens."""
    with contextlib.ExitStack() as stack:
        cables = None
        if namespaces:
            cables = Cables()
            stack.callback(cables.made.close)
            stack.enter_context(inside(cables.rest))
        world = World(folder, cables, uplinks)
        stack.callback(world.close)
        yield world
