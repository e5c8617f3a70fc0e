"""Who is let in, who is talked to: everybody else is refused, and is sent nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh

from fogft.link.probe_frames import encode_probe
from fogft.link.zenoh import settings as config
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.link.zenoh.settings import LinkSettings
from fogft.model import names
from fogft.model.credentials import CredentialPaths
from fogft.model.replica import LinkState
from fogft.pool.credentials.authority import Role
from tests.link.wire_pool import (
    POOL_UID,
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    hears,
    keys,
    peer,
    request_id,
    wait_for,
)
from tests.records import certificate_names


@pytest.fixture
def stranger(tmp_path: Path) -> Authority:
    """Another CA, which issues certificates with the very same names."""
    return Authority(tmp_path / "stranger")


def _refused(link: ZenohLink, words: str) -> None:
    wait_for(lambda: words in link.status().detail)
    assert not link.usable
    assert link.status().state is LinkState.CONNECTING
    assert not link.offer(SERVICE, request_id(1), b"secret", 1.0)


def _heard_nothing(replica: ReplicaProcess) -> bool:
    counters = replica.ask()
    return not {"requests", "probes", "malformed"} & set(counters)


def test_a_robot_of_another_ca_is_refused(
    authority: Authority,
    stranger: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
) -> None:
    """It even trusts the right CA: its own certificate is what the replica refuses."""
    replica = start_replica()
    theirs = stranger.robot()
    link = dial(
        replica.endpoint,
        files=CredentialPaths(authority.robot().ca, theirs.certificate, theirs.key),
    )
    _refused(link, "from a different CA")
    assert _heard_nothing(replica)


def test_a_replica_of_another_ca_is_refused(
    stranger: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
) -> None:
    """It has the right name, from the wrong CA."""
    replica = start_replica(files=stranger.replica())
    _refused(dial(replica.endpoint), "certificate is refused")
    assert _heard_nothing(replica)


@pytest.mark.parametrize(("ours", "side"), [(99, "there"), (1, "here")])
def test_a_link_of_another_version_says_which_side_to_upgrade(
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
    ours: int,
    side: str,
) -> None:
    replica = start_replica()
    request.addfinalizer(encode_probe.cache_clear)
    for module in ("frame", "probe_frames"):
        monkeypatch.setattr(f"fogft.link.{module}.VERSION", ours)
    _refused(dial(replica.endpoint), f"{ours} here: upgrade fogft {side}")


def test_a_replicas_certificate_cannot_ask(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
) -> None:
    """A stolen replica's key is no way to the other replicas."""
    replica = start_replica()
    _refused(dial(replica.endpoint, files=authority.replica(1)), "certificate")
    assert _heard_nothing(replica)


def test_a_robots_certificate_cannot_answer(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
) -> None:
    """Not even one that bears a replica's name."""
    files = authority.issue(peer("").id.certificate_name, Role.ROBOT)
    replica = start_replica(files=files)
    _refused(dial(replica.endpoint), "certificate is refused")
    assert _heard_nothing(replica)


def test_no_certificate_is_refused(
    authority: Authority, start_replica: Callable[..., ReplicaProcess]
) -> None:
    """A bare Zenoh client with the right CA and no certificate of its own."""
    replica = start_replica()
    settings = config.robot_settings(peer(replica.endpoint), authority.robot(), LinkSettings())
    del settings["transport/link/tls"]["connect_certificate"]
    del settings["transport/link/tls"]["connect_private_key"]
    settings["transport/link/tls"]["enable_mtls"] = False
    with pytest.raises(zenoh.ZError):
        zenoh.open(config.to_zenoh(settings))
    assert _heard_nothing(replica)


def test_a_replica_out_of_its_time_is_refused(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
) -> None:
    """The words tell which of both it is: the robot's clock may be the one that is wrong."""
    name = peer("").id.certificate_name
    replica = start_replica(files=authority.issue(name, Role.REPLICA, days=-1))
    link = dial(replica.endpoint)
    _refused(link, "expired at")
    assert "this machine's clock says" in link.status().detail
    assert _heard_nothing(replica)


def test_a_robot_out_of_its_time_is_told_whose_clock_it_is(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
) -> None:
    """The replica refuses it; by our own clock we see why."""
    replica = start_replica()
    name = certificate_names.robot(POOL_UID, "robot")
    link = dial(replica.endpoint, files=authority.issue(name, Role.ROBOT, days=-1))
    _refused(link, "our certificate has expired")
    assert "this machine's clock says" in link.status().detail
    assert _heard_nothing(replica)


@pytest.mark.parametrize(("slot", "generation"), [(1, 1), (0, 2)])
def test_another_replica_at_the_endpoint_is_sent_nothing(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    slot: int,
    generation: int,
) -> None:
    """Same CA, same role, another slot or generation: it even serves slot 0's keys in vain."""
    impostor = start_replica(files=authority.replica(slot, generation))
    _refused(dial(impostor.endpoint), f"`replica.{slot}.{generation}.{POOL_UID}`, not of")
    assert _heard_nothing(impostor)


def test_an_impostor_after_a_restart_is_sent_nothing(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
) -> None:
    """The link was up; then another slot's certificate answers at the same port."""
    replica = start_replica()
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    replica.kill()
    impostor = start_replica(endpoint=replica.endpoint, files=authority.replica(1))
    wait_for(lambda: "has the certificate of" in link.status().detail)
    assert not link.offer(SERVICE, request_id(1), b"secret", 1.0)
    assert _heard_nothing(impostor)
    assert link.status().state is LinkState.SUSPECT


def test_nothing_is_sent_to_an_impostor_after_a_reconnect(
    authority: Authority, start_replica: Callable[..., ReplicaProcess]
) -> None:
    """Zenoh's own reconnecting is covered too: the session's access list knows one name only.

    The session is used bare here, since a link throws its session away at the first loss.
    """
    replica = start_replica()
    settings = config.robot_settings(peer(replica.endpoint), authority.robot(), LinkSettings())
    session = zenoh.open(config.to_zenoh(settings))
    try:
        probe_key = names.slot_key(POOL_UID, 0, names.PROBE)

        def heard() -> bool:
            list(session.get(probe_key, payload=b"{}", timeout=5.0))
            return replica.count("malformed") >= 1

        wait_for(heard)
        replica.kill()
        wait_for(lambda: not session.info.links())
        impostor = start_replica(endpoint=replica.endpoint, files=authority.replica(1))
        wait_for(lambda: [li.auth_identifier for li in session.info.links()] != [])
        for key in (probe_key, keys(0)[SERVICE], "**"):
            assert list(session.get(key, payload=b"secret", timeout=1.0)) == []
        assert _heard_nothing(impostor)
    finally:
        session.close()


def test_a_robot_that_did_not_greet_is_neither_heard_nor_told_anything(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
) -> None:
    """A hostile robot, bound by no access list of its own, cannot answer in a replica's place."""
    replica = start_replica()
    settings = config.robot_settings(peer(replica.endpoint), authority.robot("eve"), LinkSettings())
    del settings["access_control"]
    session = zenoh.open(config.to_zenoh(settings))
    stolen: list[object] = []
    try:
        thief = session.declare_queryable(f"fogft/{POOL_UID}/**", stolen.append)
        listener = session.declare_subscriber("**", stolen.append)
        away = zenoh.Locality.REMOTE
        session.put(keys(0)[SERVICE], b"published", allowed_destination=away)
        for key in (names.slot_key(POOL_UID, 1, names.PROBE), "@/**"):
            assert list(session.get(key, timeout=1.0, allowed_destination=away)) == []
        link = dial(replica.endpoint)
        wait_for(lambda: link.usable)
        for number in range(20):
            link.offer(SERVICE, request_id(number), b"mine", 10.0)
        wait_for(lambda: len(owner.answers) == 20)
        assert {a.payload for _, a in owner.answers} == {b"mine"}
        assert stolen == []
        del thief, listener
    finally:
        session.close()


@pytest.mark.parametrize("attachment", [None, b"", b"garbage", b"\x01" + bytes(40)])
def test_a_request_that_cannot_be_read_is_counted(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
    attachment: bytes | None,
) -> None:
    """Nobody knows whose it is; the listener goes on."""
    replica = start_replica()
    settings = config.robot_settings(peer(replica.endpoint), authority.robot("eve"), LinkSettings())
    session = zenoh.open(config.to_zenoh(settings))
    try:
        hears(session, keys(0)[SERVICE])
        for times in (1, 2):
            session.put(keys(0)[SERVICE], b"x", attachment=attachment)
            wait_for(lambda times=times: replica.count("malformed") == times)  # type: ignore[misc]
    finally:
        session.close()
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    assert link.offer(SERVICE, request_id(1), b"good", 20.0)
    wait_for(lambda: owner.of(1))
    assert owner.of(1)[0].payload == b"good"
