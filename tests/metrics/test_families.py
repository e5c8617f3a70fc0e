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
from fogft.metrics.scrape import family, histogram
from fogft.pool.manager.tally import of_pool
from tests.fakes.pools import STATUS
from tests.metrics.samples import CLIENT, LINK, POOL, PROCESSES, tally, text
from tests.needs import needs


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
    for one in parsed(PROCESSES[process]()):
        for sample in one.samples:
            assert {"pool", "pool_uid"} & sample.labels.keys() or one.name == "fogft_build_info"


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
    said = text(of_pool(STATUS, tally()), POOL)
    assert value(
        said,
        "fogft_replica_info",
        slot=str(replica.slot),
        generation=str(replica.generation),
        location=replica.location,
    ) == 1  # fmt: skip


def one(families: Iterable[Metric]) -> str:
    return "".join(
        line + "\n"
        for line in text(families, {}).splitlines()
        if not re.search("build|process_", line)
    )


@given(label=st.text(st.characters(exclude_categories=["Cs"])), number=st.floats(allow_nan=False))
def test_a_label_and_a_value_come_back(label: str, number: float) -> None:
    said = text([family("m", "help", [(number, {"service": label})])], {})
    assert value(said, "m", service=label) == number


def test_a_lone_surrogate_can_be_sent() -> None:
    assert "m{" in text([family("m", "help", [(1, {"service": "\ud800"})])], {})


@given(counts=st.lists(st.integers(0, 1000), min_size=3, max_size=3))
def test_a_histogram_is_cumulative_and_ends_with_its_count(counts: list[int]) -> None:
    said = text([histogram("h", "help", (0.5, 2.0), [(counts, 9.5, {"s": "x"})])], {})
    buckets = [value(said, "h_bucket", le=le) for le in ("0.5", "2.0", "+Inf")]
    assert buckets == [sum(counts[: n + 1]) for n in range(3)]
    assert value(said, "h_count", s="x") == buckets[-1]
    assert value(said, "h_sum", s="x") == 9.5


def test_a_manager_counts_what_happened_to_machines_and_how_long_launches_took() -> None:
    """A spot machine that had its notice and then went is one preemption."""
    said = PROCESSES["manager"]()
    assert value(said, "fogft_pool_launches_total", market="spot") == 1
    assert value(said, "fogft_pool_launches_total", market="on_demand") == 1
    assert value(said, "fogft_pool_lost_replicas_total", kind="preempted") == 1
    assert value(said, "fogft_pool_lost_replicas_total", kind="gone") == 1
    assert value(said, "fogft_pool_refused_launches_total", cause="capacity") == 1
    assert value(said, "fogft_pool_failed_launches_total", cause="setup") == 1
    name = "fogft_pool_launch_duration_seconds"
    assert value(said, f"{name}_count", phase="total") == 1
    assert value(said, f"{name}_sum", phase="total") == 40
    assert value(said, f"{name}_bucket", phase="total", le="60.0") == 1
    assert value(said, f"{name}_bucket", phase="total", le="30.0") == 0


def test_every_process_tells_its_processor_time_and_memory() -> None:
    for said in PROCESSES.values():
        assert value(said(), "process_cpu_seconds_total") > 0
        assert value(said(), "process_resident_memory_bytes") > 1e6


def test_a_family_without_samples_is_left_out() -> None:
    assert one([family("m_total", "nothing", [])]) == ""
