"""Copies of a request that reach one replica on several ways: its service runs it once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from fogft.link.uplinks import UplinkDialer
from fogft.link.zenoh.robot.dialer import ZenohDialer
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.choices import UplinkPolicy
from fogft.model.spec import ServiceSpec
from tests.link.thin_relay import ThinRelay
from tests.link.wire_pool import POOL_UID, SERVICE, TYPE, Owner, keys, peer, request_id, wait_for
from tests.proxy.gateway_pool import GatewayPool, ran

REQUESTS, LIMIT_S = 20, 90.0
PATIENT: dict[str, Any] = {"suspect_after_s": 60.0, "settings": LinkSettings(stall_after_s=60.0)}


class ByRelay:
    """Dials through one relay for each name of an interface: two ways on loopback."""

    def __init__(self, inner: ZenohDialer, relays: dict[str, ThinRelay]) -> None:
        self._inner = inner
        self._relays = relays

    def dial(self, to: Any, services: Any, events: Any) -> Any:
        at = self._relays[to.interface].endpoint
        return self._inner.dial(replace(to, endpoint=at, interface=""), services, events)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


class Scene:
    """A server proxy that is reached through two relays, and a link that uses both."""

    def __init__(self, folder: Path, policy: UplinkPolicy, work_s: float, **given: Any) -> None:
        pool = GatewayPool(folder)
        self.server = pool.server_proxy(0, delay_s=work_s)
        self.relays = {name: ThinRelay(pool.endpoint(0)) for name in ("near", "far")}
        inner = ZenohDialer(pool.authority.robot(), robot="robot", pool_uid=POOL_UID, **given)
        self.dialer, self.owner = UplinkDialer(ByRelay(inner, self.relays)), Owner()
        self.dialer.use(list(self.relays), [ServiceSpec(SERVICE, TYPE, uplink_policy=policy)])
        self.link = self.dialer.dial(peer("replica:7447"), keys(0), self.owner)
        self._folder = folder

    def wait_up(self) -> None:
        wait_for(lambda: [u["state"] for u in self.link.status().uplinks] == ["up", "up"], LIMIT_S)
        wait_for(lambda: SERVICE in self.link.ready, LIMIT_S)

    def ask(self, numbers: Iterable[int]) -> None:
        for number in numbers:
            offer = partial(self.link.offer, SERVICE, request_id(number), payload(number), LIMIT_S)
            wait_for(offer, LIMIT_S)  # on a busy machine an uplink may be in doubt for a moment

    def check(self, count: int) -> None:
        """Wait for so many answers; each is its own request's, and each was run once."""
        wait_for(lambda: self.link.flush() or len(self.owner.answers) == count, LIMIT_S)
        answers = {a.request_id: a.payload for _, a in self.owner.answers}
        assert answers == {request_id(n): payload(n) for n in range(count)}
        (counts,) = ran(self._folder).values()
        assert {n: counts[n] for n in range(count)} == dict.fromkeys(range(count), 1)

    def close(self) -> None:
        self.dialer.close()
        self.server.kill()
        self.server.wait()
        for relay in self.relays.values():
            relay.close()


def payload(number: int) -> bytes:
    return number.to_bytes(8, "big") * 250


@pytest.mark.parametrize(("work_s", "behind_s"), [(0.5, 0.1), (0.02, 0.3)])
def test_both_copies_arrive_and_the_service_runs_once(tmp_path, work_s, behind_s):
    """The second copy arrives while the first is at work, and long after that was answered."""
    scene = Scene(tmp_path, UplinkPolicy.ALL, work_s, **PATIENT)
    try:
        scene.wait_up()
        before = {name: relay.passed_bytes for name, relay in scene.relays.items()}
        scene.relays["far"].delay_s = behind_s
        scene.ask(range(REQUESTS))
        wait_for(lambda: len(scene.owner.answers) == REQUESTS, LIMIT_S)
        scene.relays["far"].delay_s = 0.0
        # What is answered before it was sent is not sent.
        least = REQUESTS * len(payload(0)) / 2
        for name, relay in scene.relays.items():
            wait_for(lambda r=relay, n=name: r.passed_bytes - before[n] > least, LIMIT_S)
        scene.ask([REQUESTS])  # after every copy
        scene.check(REQUESTS + 1)
    finally:
        scene.close()


@pytest.mark.parametrize("policy", UplinkPolicy)
@pytest.mark.parametrize("fault", ["stalls", "goes"])
def test_an_uplink_that_stalls_or_goes_costs_no_request(tmp_path, policy, fault):
    """With requests under way on it, and more after that."""
    scene = Scene(tmp_path, policy, 0.2)
    near = scene.relays["near"]
    try:
        scene.wait_up()
        scene.ask(range(10))
        if fault == "stalls":
            near.open.clear()
        else:
            near.close()
        scene.ask(range(10, 20))
        scene.check(20)
        wait_for(lambda: scene.link.status().uplinks[0]["state"] != "up", LIMIT_S)
        scene.ask(range(20, 30))
        scene.check(30)
    finally:
        near.open.set()
        scene.close()
