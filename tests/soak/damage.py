"""How each kind of fault is done to a `World`, and undone. One function a kind."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator

from tests.proxy.breaking import without_descriptors
from tests.soak.schedule import Fault
from tests.soak.world import REPLICAS, World

SLOW_S = 0.3
LONG_S = 60.0
STARVED_BYTES_PER_S = 20_000.0

Damage = Callable[[World, Fault], contextlib.AbstractContextManager[None]]


@contextlib.contextmanager
def _kill(world: World, fault: Fault) -> Iterator[None]:
    slot = fault.victim % REPLICAS
    world.machines[slot].end()
    yield
    world.relaunch(slot)


@contextlib.contextmanager
def _freeze(world: World, fault: Fault) -> Iterator[None]:
    process = world.machines[fault.victim % REPLICAS].process
    process.send_signal(signal.SIGSTOP)
    yield
    process.send_signal(signal.SIGCONT)


@contextlib.contextmanager
def _blackhole(world: World, fault: Fault) -> Iterator[None]:
    relay = world.machines[fault.victim % REPLICAS].relay
    relay.open.clear()
    yield
    relay.open.set()


@contextlib.contextmanager
def _slow(world: World, fault: Fault) -> Iterator[None]:
    relay = world.machines[fault.victim % REPLICAS].relay
    relay.delay_s = SLOW_S
    yield
    relay.delay_s = 0.0


@contextlib.contextmanager
def _starve(world: World, fault: Fault) -> Iterator[None]:
    relay = world.machines[fault.victim % REPLICAS].relay
    relay.bytes_per_s = STARVED_BYTES_PER_S
    yield
    relay.bytes_per_s = float("inf")


@contextlib.contextmanager
def _address_change(world: World, fault: Fault) -> Iterator[None]:
    slot = fault.victim % REPLICAS
    old = world.machines[slot]
    world.relaunch(slot)
    yield
    old.end(signal.SIGTERM)


@contextlib.contextmanager
def _rendezvous_death(world: World, fault: Fault) -> Iterator[None]:
    world.rendezvous.kill()
    if fault.victim % 2:
        world.rendezvous.forget()
    yield
    world.rendezvous.start()


@contextlib.contextmanager
def _gateway_death(world: World, fault: Fault) -> Iterator[None]:
    gateway = sorted(world.gateways.items())[fault.victim % len(world.gateways)][1]
    gateway.kill()
    yield
    gateway.start()


@contextlib.contextmanager
def _uplink_loss(world: World, fault: Fault) -> Iterator[None]:
    assert world.cables is not None
    number = fault.victim % 2
    world.cables.stall(number)
    yield
    world.cables.heal(number)


@contextlib.contextmanager
def _certificate_rotation(world: World, fault: Fault) -> Iterator[None]:
    world.rotate(sorted(world.robots)[fault.victim % 2])
    yield


@contextlib.contextmanager
def _all_killed(world: World, fault: Fault) -> Iterator[None]:
    for machine in world.machines:
        machine.end()
    yield
    for slot in range(REPLICAS):
        world.relaunch(slot)


@contextlib.contextmanager
def _suspend(world: World, fault: Fault) -> Iterator[None]:
    """Stop everything, as a machine does that sleeps."""
    for pid in world.pids():
        os.kill(pid, signal.SIGSTOP)
    yield
    for pid in world.pids():
        os.kill(pid, signal.SIGCONT)


@contextlib.contextmanager
def _no_descriptors(world: World, fault: Fault) -> Iterator[None]:
    with without_descriptors(world.folder, world.pids()):
        yield


@contextlib.contextmanager
def _clock_set(world: World, fault: Fault) -> Iterator[None]:
    """Set the clock of one machine, or of all, by an hour either way; and back."""
    assert world.clocks is not None
    pids = world.pids()
    chosen = fault.victim // 2 % (len(pids) + 1)
    meant = pids if chosen == len(pids) else [pids[chosen]]
    world.clocks.set(meant, 3600 if fault.victim % 2 else -3600)
    yield
    world.clocks.set(meant, 0)


@contextlib.contextmanager
def _new_uplink_address(world: World, fault: Fault) -> Iterator[None]:
    assert world.cables is not None
    world.cables.readdress(fault.victim % 2)
    yield


@contextlib.contextmanager
def _long_suspend(world: World, fault: Fault) -> Iterator[None]:
    with _suspend(world, fault):
        time.sleep(LONG_S)
        yield


DAMAGES: dict[str, Damage] = {
    "kill": _kill,
    "freeze": _freeze,
    "blackhole": _blackhole,
    "slow": _slow,
    "starve": _starve,
    "address change": _address_change,
    "rendezvous death": _rendezvous_death,
    "gateway death": _gateway_death,
    "uplink loss": _uplink_loss,
    "certificate rotation": _certificate_rotation,
    "all killed": _all_killed,
    "suspend": _suspend,
    "no descriptors": _no_descriptors,
    "clock set": _clock_set,
    "new uplink address": _new_uplink_address,
    "long suspend": _long_suspend,
}


def do(world: World, fault: Fault) -> None:
    """Do a fault, let it last, and undo it."""
    with DAMAGES[fault.kind](world, fault):
        time.sleep(fault.lasts_s)
