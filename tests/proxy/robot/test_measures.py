"""What proxies tell Prometheus: every outcome, by service, replica and reason."""

from __future__ import annotations

from fogft.metrics import proxies
from fogft.model.spec import ServiceSpec
from fogft.proxy.gateway.gateway import Forwarder
from fogft.proxy.robot.client import ClientProxy
from fogft.proxy.robot.dispatcher import Dispatcher
from tests.fakes.proxy import UID, Clock, FakeDialer, FakeLink
from tests.metrics.samples import text


def dispatcher(clock: Clock) -> tuple[Dispatcher, FakeLink]:
    made = Dispatcher(ServiceSpec("/s", "t", timeout_s=5.0), lambda handle, payload: None,
                      clock=clock)  # fmt: skip
    link = FakeLink(0)
    made.route([link])
    return made, link


def test_every_outcome_of_a_service_is_told():
    """One answered, one silent after a crash, each with its copies, its time and its reason."""
    clock = Clock()
    one, link = dispatcher(clock)
    one.submit(b"q", 1)
    clock.now += 0.2
    one.answered(link, link.reply(b"r"))
    one.submit(b"q", 2)
    one.answered(link, link.refusal("crashed"))
    clock.now += 5.0
    one.tick()
    report = {"services": {"/s": one.report()}, "links": [], "uplink_suspected": False}
    said = text(proxies.of_client(report), {}).splitlines()
    assert 'fogft_requests_total{service="/s"} 2.0' in said
    assert 'fogft_outcomes_total{outcome="answered",service="/s"} 1.0' in said
    assert 'fogft_outcomes_total{outcome="silent",service="/s"} 1.0' in said
    assert 'fogft_outcomes_total{outcome="fallback",service="/s"} 0.0' in said
    assert 'fogft_first_responses_total{service="/s",slot="0"} 1.0' in said
    assert 'fogft_refusals_total{reason="crashed",service="/s"} 1.0' in said
    assert 'fogft_request_duration_seconds_bucket{le="0.1",service="/s"} 0.0' in said
    assert 'fogft_request_duration_seconds_bucket{le="0.25",service="/s"} 1.0' in said
    assert 'fogft_request_duration_seconds_count{service="/s"} 1.0' in said


def test_a_gateway_tells_of_its_robots_too():
    clock = Clock()
    proxy = ClientProxy(UID, None, FakeDialer(), lambda *_: dispatcher(clock)[0], clock=clock)
    proxy.serve([ServiceSpec("/s", "t")])
    told = {**proxy.report(), "forwarded": Forwarder().report(), "listener": {"requests": 3}}
    said = text(proxies.of_gateway(told), {}).splitlines()
    assert 'fogft_gateway_requests_total{event="passed"} 0.0' in said
    assert 'fogft_listener_events_total{event="requests"} 3.0' in said
    assert 'fogft_pending_requests{service="/s"} 0.0' in said
