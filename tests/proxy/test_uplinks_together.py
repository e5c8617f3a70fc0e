"""Copies of a request that reach one replica on several ways: its service runs it once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from fogft.core.spec import ServiceSpec
from fogft.core.uplinks import UplinkPolicy
from fogft.wire.config import LinkSettings
from fogft.wire.uplinks import UplinkDialer
from fogft.wire.zenoh_dialer import ZenohDialer
from tests.proxy.gateway_pool import GatewayPool, ran
from tests.wire.thin_relay import ThinRelay
from tests.wire.wire_pool import POOL_UID, SERVICE, TYPE, Owner, keys, peer, request_id, wait_for

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


@pytest.mark.parametrize(("work_s", "behind_s"), [(0.5, 0.1), (0.02, 0.3)])
def test_both_copies_arrive_and_the_service_runs_once(tmp_path, work_s, behind_s):
    """The second copy arrives while the first is at work, and long after that was answered."""
    pool = GatewayPool(tmp_path)
    server = pool.server_proxy(0, delay_s=work_s)
    relays = {name: ThinRelay(pool.endpoint(0)) for name in ("near", "far")}
    inner = ZenohDialer(pool.authority.robot(), robot="robot", pool_uid=POOL_UID, **PATIENT)
    dialer, owner = UplinkDialer(ByRelay(inner, relays)), Owner()
    dialer.use(list(relays), [ServiceSpec(SERVICE, TYPE, uplinks=UplinkPolicy.ALL)])
    payloads = [n.to_bytes(8, "big") * 250 for n in range(REQUESTS)]
    try:
        link = dialer.dial(peer("replica:7447"), keys(0), owner)
        wait_for(lambda: [u["state"] for u in link.uplinks()] == ["up", "up"], LIMIT_S)
        wait_for(lambda: SERVICE in link.ready, LIMIT_S)
        before = [relay.passed_bytes for relay in relays.values()]
        relays["far"].delay_s = behind_s
        for number, payload in enumerate(payloads):
            assert link.offer(SERVICE, request_id(number), payload, LIMIT_S)
        wait_for(lambda: len(owner.answers) == REQUESTS, LIMIT_S)
        relays["far"].delay_s = 0.0
        least = sum(map(len, payloads)) / 2  # what is answered before it was sent is not sent
        for relay, had in zip(relays.values(), before, strict=True):
            wait_for(lambda relay=relay, had=had: relay.passed_bytes - had > least, LIMIT_S)
        assert link.offer(SERVICE, request_id(REQUESTS), b"one more", LIMIT_S)  # after every copy
        wait_for(lambda: owner.of(REQUESTS), LIMIT_S)
        answers = {a.request_id: a.payload for _, a in owner.answers}
        assert [answers[request_id(n)] for n in range(REQUESTS)] == payloads
        (counts,) = ran(tmp_path).values()
        assert {n: counts[n] for n in range(REQUESTS)} == dict.fromkeys(range(REQUESTS), 1)
    finally:
        dialer.close()
        server.kill()
        server.wait()
        for relay in relays.values():
            relay.close()
