"""Whatever a file of the proxies holds: a value, or one clear error; never another exception."""

from __future__ import annotations

import contextlib
import errno
import json
import re
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fogft import disk
from fogft.errors import FogftError
from fogft.model import membership
from fogft.model.credentials import Holder, Role
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.proxy.config import read_client, read_server
from fogft.proxy.robot import process
from fogft.proxy.robot.following import Following
from tests.fakes.proxy import UID

CLIENT = f"""\
pool: p
pool_uid: "{UID}"
robot: robot
membership: membership.json
status: proxy-status.json
lock: proxy.lock
credentials: {{ca: ca.crt, certificate: robot.crt, key: robot.key}}
services: [{{name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 2.0}}]
suspect_after_s: 2.0
domain_id: 3
"""
REPLICA = f"""\
pool: p
pool_uid: "{UID}"
slot: 0
generation: 1
listen: 127.0.0.1:7447
services: [{{name: /plan, type: nav_msgs/srv/GetPlan}}]
run: exec serve
credentials: {{ca: ca.crt, certificate: replica.crt, key: replica.key}}
"""
MEMBERS = json.dumps(
    membership.to_dict(Membership("p", UID, 1, 1, (Member(ReplicaId(UID, 0, 1), "h:1"),)))
)


def damaged(text: str) -> st.SearchStrategy[bytes]:
    """The text cut off, with bytes struck out, or with bytes put in."""
    whole = text.encode()
    at = st.integers(0, len(whole))
    scrap = st.binary(max_size=8) | st.sampled_from(
        [b"[", b"{", b": ", b"null", b".nan", b"-1", b"&a ", b"*a", b"!!int ", b"1e999", b"\xff"]
    )
    cut = at.map(lambda end: whole[:end])
    changed = st.tuples(at, st.integers(0, 20), scrap).map(
        lambda c: whole[: c[0]] + c[2] + whole[c[0] + c[1] :]
    )
    return cut | changed | st.binary(max_size=60)


def value_or_error(read, path: Path, content: bytes):
    path.write_bytes(content)
    with contextlib.suppress(FogftError):
        return read(path)
    return None


@given(damaged(CLIENT))
@example(b"a: 2020-13-45")
@example(b"a: !!timestamp foo")
@example(b"[" * 100_000)
def test_a_damaged_proxy_yaml(tmp_path_factory, content):
    value_or_error(read_client, tmp_path_factory.getbasetemp() / "proxy.yaml", content)


@given(damaged(REPLICA))
def test_a_damaged_replica_yaml(tmp_path_factory, content):
    value_or_error(read_server, tmp_path_factory.getbasetemp() / "replica.yaml", content)


@given(damaged(MEMBERS))
@example(b"[" * 100_000)
@example(b'{"epoch": 1e999}')
def test_a_damaged_membership_names_nobody_else(tmp_path_factory, content):
    """Its checksum tells: what is read is what was written, or nothing."""

    def read(path: Path) -> Membership:
        return membership.from_dict(disk.read_json(path))

    found = value_or_error(read, tmp_path_factory.getbasetemp() / "membership.json", content)
    assert found is None or membership.to_dict(found) == json.loads(MEMBERS)


@pytest.mark.parametrize(
    ("key", "wrong"),
    [
        ("timeout_s: 2.0", "timeout_s: -1"),
        ("timeout_s: 2.0", "timeout_s: .nan"),
        ("suspect_after_s: 2.0", "suspect_after_s: .inf"),
        ("robot: robot", "robot: ''"),
        ("robot: robot", "robot: " + "x" * 65),
        (f'pool_uid: "{UID}"', "pool_uid: 0123456789"),
    ],
)
def test_a_value_that_would_break_a_link_later_is_an_error_now(tmp_path, key, wrong):
    (tmp_path / "proxy.yaml").write_text(CLIENT.replace(key, wrong))
    with pytest.raises(FogftError, match=r"proxy\.yaml:\d+: .*" + key.partition(":")[0]):
        read_client(tmp_path / "proxy.yaml")


@pytest.mark.parametrize(
    ("line", "source"),
    [
        ("", "auto"),
        ("notice: null", "auto"),
        ("notice: none", "none"),
        ("notice: gcp", "gcp"),
        ("notice: file:notice.json", "file:{folder}/notice.json"),
        ("notice: file:/run/notice", "file:/run/notice"),
    ],
)
def test_where_notices_come_from(tmp_path, line, source):
    """A file is found from the configuration's own folder."""
    (tmp_path / "replica.yaml").write_text(f"{REPLICA}{line}\n")
    assert read_server(tmp_path / "replica.yaml").notice == source.format(folder=tmp_path)


@pytest.mark.parametrize("line", ["notice: no", "notice: 'file:'", "notice: ibm", "notice: []"])
def test_an_unknown_source_of_notices_is_an_error(tmp_path, line):
    (tmp_path / "replica.yaml").write_text(f"{REPLICA}{line}\n")
    with pytest.raises(FogftError, match=r"replica\.yaml:\d+: notice: ") as caught:
        read_server(tmp_path / "replica.yaml")
    assert re.search("one of file:PATH|of type `str`", caught.value.message)


def test_a_file_that_stays_bad_is_logged_once(tmp_path, caplog):
    """A full disk would else be told of twice a second, into a log on that disk."""

    def fail() -> None:
        raise FogftError("no space left")

    for _ in range(5):
        process.try_step(fail, tmp_path / "x")
    assert caplog.text.count("no space left") == 1
    process.try_step(lambda: None, tmp_path / "x")
    process.try_step(fail, tmp_path / "x")
    assert caplog.text.count("no space left") == 2


def test_a_replica_that_cannot_know_its_address_is_told(tmp_path: Path) -> None:
    """`fogft serve --advertise` comes before the file; what is no endpoint is an error."""
    path = tmp_path / "replica.yaml"
    path.write_text(f"{REPLICA}advertise: 10.0.0.1:7447\n")
    assert read_server(path).advertise == "10.0.0.1:7447"
    assert read_server(path, advertise="vm.example.org:30001").advertise == "vm.example.org:30001"
    with pytest.raises(FogftError, match="not `host:port`"):
        read_server(path, advertise="vm.example.org")


def test_a_membership_that_cannot_be_read_for_a_moment_is_read_then(tmp_path, monkeypatch):
    """Else the robot would keep the old one until the next change."""
    (tmp_path / "proxy.yaml").write_text(CLIENT)
    config = read_client(tmp_path / "proxy.yaml")
    monkeypatch.setattr(Following, "holder", lambda _: Holder(Role.ROBOT, "robot", 1, UID))
    seen = Following(config)
    assert seen.look() is None
    config.membership.write_text(MEMBERS)
    with monkeypatch.context() as patch:
        full = OSError(errno.EMFILE, "Too many open files")
        patch.setattr(disk, "read_json", lambda *_: (_ for _ in ()).throw(full))
        with pytest.raises(OSError, match="Too many"):
            seen.look()
    found = seen.look()
    assert found is not None
    assert [one.id.slot for one in found.members] == [0]


def test_a_membership_that_stays_damaged_is_told_and_read_once_it_is_whole(tmp_path, monkeypatch):
    (tmp_path / "proxy.yaml").write_text(CLIENT)
    config = read_client(tmp_path / "proxy.yaml")
    monkeypatch.setattr(Following, "holder", lambda _: Holder(Role.ROBOT, "robot", 1, UID))
    config.membership.write_text(MEMBERS)
    seen = Following(config)
    assert seen.look() is not None
    config.membership.write_text("{")
    with pytest.raises(FogftError):
        seen.look()
    with pytest.raises(FogftError):
        seen.look()
    config.membership.write_text(MEMBERS)
    assert seen.look() is not None
