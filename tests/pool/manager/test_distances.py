"""Distances: told, measured against a server of our own, kept, guessed; never trusted blindly."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from fogft import disk
from fogft.model.choices import PlacementSpec
from fogft.model.replica import (
    LinkReport,
    LinkState,
    Machine,
    MachinePhase,
    Observed,
    Offer,
    Placement,
    ReplicaId,
)
from fogft.model.spec import PoolSpec
from fogft.pool.manager import distances
from fogft.pool.manager.distances import Distances, Latencies, connect_time
from tests.fakes.threads import amid

NEAR, FAR, DEAD = "aws/us-west-1", "aws/eu-central-1", "aws/us-east-1"
NOW = 1_700_000_000.0


@contextlib.contextmanager
def listening() -> Iterator[tuple[str, int]]:
    """A server that accepts, as a provider's endpoint does."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    server.accept()[0].close()

        thread = threading.Thread(target=accept, daemon=True)
        thread.start()
        yield server.getsockname()
        server.shutdown(socket.SHUT_RDWR)
        thread.join(5)


def closed_port() -> tuple[str, int]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()


def test_a_connect_is_timed():
    with listening() as (host, port):
        assert 0 < connect_time(host, port) < 2


def test_what_does_not_answer_is_an_error():
    with pytest.raises(OSError):
        connect_time(*closed_port())


@pytest.fixture
def near(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every region answers soon."""
    monkeypatch.setattr(distances, "connect_time", lambda host, port: 0.05)


def test_measurements_are_kept_for_a_day(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    now = [NOW]
    with listening() as address:
        places = {NEAR: address, DEAD: closed_port()}
        monkeypatch.setattr(distances, "endpoint", places.get)
        known = Latencies(tmp_path / "home" / "l.json", clock=lambda: now[0])
        assert known.stale([NEAR, DEAD, "local/x"]) == [DEAD, NEAR]
        failed = known.measure([NEAR, DEAD, "local/x"])
    assert list(failed) == [DEAD]
    assert "refused" in failed[DEAD].lower()
    [distance] = known.known([NEAR, DEAD], PlacementSpec(), {}).values()
    assert (distance.source, distance.as_of) == ("measured", NOW)
    assert known.stale([NEAR]) == []
    now[0] = NOW + 86_400
    assert known.stale([NEAR]) == [NEAR]
    now[0] = NOW - 10  # the clock jumped back: measure again
    assert known.stale([NEAR]) == [NEAR]
    assert NEAR in known.known([NEAR], PlacementSpec(), {})  # an old figure beats none


def test_who_is_believed_first(tmp_path: Path, near: None):
    known = Latencies(tmp_path / "l.json", clock=lambda: NOW)
    known.measure([NEAR, FAR])
    berkeley = (37.87, -122.26)
    told = PlacementSpec(robot_at=berkeley, rtt_s={NEAR: 0.001, "gcp": 0.2})
    regions = [NEAR, FAR, DEAD, "gcp/us-west1", "gcp/moon1", "local/x"]
    found = known.known(regions, told, {FAR: 0.06, "local/x": 0.0001})
    assert {region: d.source for region, d in found.items()} == {
        NEAR: "pool file",
        FAR: "links",
        DEAD: "estimated",
        "gcp/us-west1": "pool file",
        "gcp/moon1": "pool file",
    }
    assert found[FAR].rtt_s == 0.06


@pytest.mark.parametrize("content", ["", "{", "[]", '{"aws/us-west-1": {"rtt_s": "x"}}', "\x00"])
def test_a_damaged_file_holds_nothing(tmp_path: Path, near: None, content: str):
    file = tmp_path / "l.json"
    file.write_text(content)
    known = Latencies(file)
    assert known.measured() == {}
    assert known.measure([NEAR]) == {}
    assert known.measured()[NEAR].rtt_s == 0.05


def test_estimates_grow_with_the_distance():
    here = (37.87, -122.26)
    regions = ["aws/us-west-1", "aws/us-west-2", "aws/us-east-1", "aws/eu-central-1"]
    guesses = [distances.estimated_rtt_s(here, distances.positions()[r]) for r in regions]
    assert guesses == sorted(guesses)
    assert guesses[0] < 0.02
    assert 0.1 < guesses[-1] < 0.25


def test_every_place_and_cloud_has_an_endpoint():
    assert {region.split("/")[0] for region in distances.positions()} == {"aws", "azure", "gcp"}
    for region, (latitude, longitude) in distances.positions().items():
        host, port = distances.endpoint(region)
        assert region.split("/")[1] in host
        assert port == 443
        assert -90 <= latitude <= 90
        assert -180 <= longitude <= 180
    assert distances.endpoint("local/us-west-1") is None


def test_one_slow_probe_moves_nothing(tmp_path: Path, near: None, monkeypatch: pytest.MonkeyPatch):
    """The manager takes the median of the last round trips to a region."""
    monkeypatch.setattr(distances, "on_thread", lambda run, *given: run(*given))
    found = Distances(Latencies(tmp_path / "l.json"))
    place = Placement("aws", "us-west-1", "a", "m1")
    id = ReplicaId("0" * 16, 0, 1)
    machine = Machine(id, place, MachinePhase.RUNNING, 0.0)
    spec = PoolSpec("p", ())

    def look(rtt_s: float) -> float:
        link = LinkReport(id, LinkState.UP, rtt_s=rtt_s)
        seen = Observed(0.0, (machine,), (link,), (Offer(place, 0.1),))
        return found(spec, seen)[NEAR]

    for _ in range(5):
        assert look(0.02) == 0.02
    assert look(3.0) == 0.02


def test_of_two_managers_that_measure_at_once_neither_forgets_what_the_other_has(
    tmp_path: Path, near: None, monkeypatch: pytest.MonkeyPatch
):
    """Its regions would be without a distance for a quarter of an hour."""
    known = Latencies(tmp_path / "l.json", clock=lambda: NOW)
    write, others = disk.write_json, list[Future[object]]()

    def written(*given: Any, **how: Any) -> None:
        if not others:
            others.append(threads.submit(object))
            others[0] = amid(threads, lambda: known.measure([FAR]), tmp_path / "l.lock")
        write(*given, **how)

    monkeypatch.setattr(disk, "write_json", written)
    with ThreadPoolExecutor(1) as threads:
        known.measure([NEAR])
        others[0].result()
    assert known.measured().keys() == {NEAR, FAR}
