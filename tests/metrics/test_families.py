"""Every process's metrics: what Prometheus's own tools and parser make of them, and the page."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families as parsed

import fogft
from fogft.metrics import proxies
from fogft.metrics.families import counter, gauge, histogram, text
from fogft.metrics.outcomes import BUCKETS_S, OUTCOMES_COUNTED
from fogft.pool.manager.metrics import of_pool, of_rendezvous
from tests.cli.pools import STATUS
from tests.docs.documents import ROOT
from tests.needs import needs

PAGE = (ROOT / "docs" / "metrics.md").read_text()
SERVICE = {
    **dict.fromkeys(OUTCOMES_COUNTED, 3),
    "pending": 1,
    "refused": {"crashed": 2},
    "won": {"0.1": 4, "0.2": 5, "1.1": 6},
    "buckets": [1] * (len(BUCKETS_S) + 1),
    "took_s": 12.5,
}
LINK = {
    "slot": 0,
    "generation": 1,
    "state": "up",
    "ready": ["/s"],
    "silent_for_s": 0.0,
    "rtt_s": 0.01,
    "in_flight": 2,
    "reopened": 1,
    "restarts": 0,
}
CLIENT = {
    "services": {"/s": SERVICE},
    "links": [LINK, {**LINK, "slot": 1, "rtt_s": None}],
    "topics": {"/t": {"passed": 5, "dropped": 1, "trouble": ""}},
    "uplink_suspected": False,
}
SERVER = {
    "work": dict.fromkeys(
        ("held", "ran", "ran_s", "saved", "interrupted", "wasted", "wasted_s"), 1
    ),
    "refused": {"overloaded": 1},
    "limits": {"/s": 4},
    "services": {"/s": True},
    "draining": False,
    "restarts": 1,
    "wire": {"requests": 3},
}
GATEWAY = {
    **CLIENT,
    "forwarded": {"in_flight": 1, "passed": 3, "joined": 1, "refused": {"overloaded": 1}},
    "listener": {"requests": 3},
}
RENDEZVOUS = {
    "callers": 2,
    "records": 5,
    "port": {"refused": 1},
    "messages": {"hello": 1},
    "offered": {"new": 1},
}
POOL = {"pool": "p"}
PROCESSES = {
    "client proxy": lambda: text(proxies.of_client(CLIENT), POOL),
    "server proxy": lambda: text(proxies.of_server(SERVER), {**POOL, "slot": "0"}),
    "gateway": lambda: text(proxies.of_gateway(GATEWAY), POOL),
    "manager": lambda: text(of_pool(STATUS), POOL),
    "rendezvous": lambda: text(of_rendezvous(RENDEZVOUS), {"pool_uid": "0123456789012345"}),
}


def value(said: str, name: str, **labels: str) -> float:
    """Return a sample's value, as Prometheus's own parser reads it."""
    [found] = [
        sample.value
        for family in parsed(said)
        for sample in family.samples
        if sample.name == name and labels.items() <= sample.labels.items()
    ]
    return found


@needs("promtool")
@pytest.mark.parametrize("process", PROCESSES)
def test_prometheus_finds_nothing_to_mend(process: str) -> None:
    done = subprocess.run(
        ["promtool", "check", "metrics"],
        input=PROCESSES[process](),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.parametrize("process", PROCESSES)
def test_every_sample_says_whose_it_is(process: str) -> None:
    for family in parsed(PROCESSES[process]()):
        for sample in family.samples:
            assert {"pool", "pool_uid"} & sample.labels.keys() or family.name == "fogft_build_info"


def test_a_version_is_told_by_every_process() -> None:
    for said in PROCESSES.values():
        assert value(said(), "fogft_build_info", version=fogft.__version__) == 1


def test_generations_of_a_slot_are_one_series() -> None:
    said = PROCESSES["client proxy"]()
    assert value(said, "fogft_first_responses_total", slot="0", service="/s") == 9
    assert value(said, "fogft_first_responses_total", slot="1", service="/s") == 6


def test_a_slot_has_one_series_while_its_machine_is_replaced() -> None:
    """Prometheus refuses two samples of one series; the newer machine's link is told."""
    old = {**LINK, "in_flight": 7}
    new = {**LINK, "generation": 2, "state": "connecting", "in_flight": 0}
    for links in ([old, new], [new, old]):
        said = text(proxies.of_client({**CLIENT, "links": links}), POOL)
        assert value(said, "fogft_link_requests_in_flight", slot="0") == 0
        assert value(said, "fogft_link_up", slot="0") == 0


def test_a_slots_machine_is_told_as_information() -> None:
    replica = STATUS.replicas[0]
    said = text(of_pool(STATUS), POOL)
    assert value(
        said,
        "fogft_replica_info",
        slot=str(replica.slot),
        generation=str(replica.generation),
        location=replica.location,
    ) == 1  # fmt: skip


def test_the_page_lists_every_metric_and_no_other() -> None:
    told = {
        family.name + ("_total" if family.type == "counter" else "")
        for said in PROCESSES.values()
        for family in parsed(said())
    }
    assert set(re.findall(r"^\| `(fogft_\w+)` ", PAGE, flags=re.MULTILINE)) == told


def one(families: Iterable[Metric]) -> str:
    return "".join(line + "\n" for line in text(families, {}).splitlines() if "build" not in line)


@given(label=st.text(st.characters(exclude_categories=["Cs"])), number=st.floats(allow_nan=False))
def test_a_label_and_a_value_come_back(label: str, number: float) -> None:
    said = text([gauge("m", "help", [(number, {"service": label})])], {})
    assert value(said, "m", service=label) == number


def test_a_lone_surrogate_can_be_sent() -> None:
    assert "m{" in text([gauge("m", "help", [(1, {"service": "\ud800"})])], {})


@given(counts=st.lists(st.integers(0, 1000), min_size=3, max_size=3))
def test_a_histogram_is_cumulative_and_ends_with_its_count(counts: list[int]) -> None:
    said = text([histogram("h", "help", (0.5, 2.0), [(counts, 9.5, {"s": "x"})])], {})
    buckets = [value(said, "h_bucket", le=le) for le in ("0.5", "2.0", "+Inf")]
    assert buckets == [sum(counts[: n + 1]) for n in range(3)]
    assert value(said, "h_count", s="x") == buckets[-1]
    assert value(said, "h_sum", s="x") == 9.5


def test_a_family_without_samples_is_left_out() -> None:
    assert one([counter("m_total", "nothing", [])]) == ""
