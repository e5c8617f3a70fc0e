"""What the manager writes is what the proxies read."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import os
import tempfile
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fogft.errors import StateError
from fogft.model.choices import MetricsSpec, Middleware, Speaks
from fogft.model.replica import Offer, Placement, ReplicaId
from fogft.model.spec import MAX_HOURS, HealthSpec, OnTimeout, PoolSpec, ServiceSpec
from fogft.planning.planner import PlannedLaunch
from fogft.pool.credentials import authority
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity
from fogft.pool.manager import configuration
from fogft.proxy.config import read_client, read_server
from fogft.records.signing import Signer
from tests.fakes.threads import amid

UID = "0123456789abcdef"
SERVICES = (
    ServiceSpec("/plan", "nav_msgs/srv/GetPlan", 2.5, OnTimeout.EMPTY),
    ServiceSpec("/switch", "std_srvs/srv/SetBool", 10.0, OnTimeout.SILENT, "success"),
)
NASTY = "a: 'b' \"c\" # ${PATH} {x} \\ \n- ü\t%"


@pytest.fixture
def paths(tmp_path: Path) -> PoolPaths:
    paths = PoolPaths(tmp_path)
    authority.create_authority(paths.credentials, UID)
    return paths


def identity(tmp: Path) -> Identity:
    return Identity("pool", UID, "mock", str(tmp / "src" / "pool.yaml"), 0.0)


def spec(**task: object) -> PoolSpec:
    health = HealthSpec(suspect_after_s=3.5)
    whole = {"run": "exec serve", **task}
    return PoolSpec("pool", SERVICES, health=health, task=whole)


def test_each_side_is_told_how_it_speaks_ros(paths: PoolPaths) -> None:
    """The robot's way stands in its proxy's configuration, the replica's in its own."""
    asked = replace(spec(), rmw=Middleware(robot=Speaks.ZENOH, replica=Speaks.RCLPY))
    configuration.write_proxy_config(paths, identity(paths.folder), asked)
    assert read_client(paths.proxy_config).rmw is Speaks.ZENOH
    order = configuration.build_order(paths, identity(paths.folder), asked, planned(), b"signed")
    for name, content in order.files.items():
        (paths.folder / name).write_bytes(content)
    assert read_server(paths.folder / "replica.yaml").rmw is Speaks.RCLPY


def planned() -> PlannedLaunch:
    offer = Offer(Placement("c", "r", "a", "m1"), 0.25)
    return PlannedLaunch(3, 7, offer, "because")


def test_the_client_proxy_reads_what_was_written(paths: PoolPaths) -> None:
    """Every key survives, and paths lead to the pool's files."""
    configuration.write_proxy_config(paths, identity(paths.folder), spec())
    config = read_client(paths.proxy_config)
    assert (config.pool, config.pool_uid, config.services) == ("pool", UID, SERVICES)
    assert (config.suspect_after_s, config.domain_id) == (3.5, None)
    assert (config.membership, config.status) == (paths.membership, paths.proxy_status)
    assert (config.lock, config.announcements) == (paths.proxy_lock, paths.announcements)
    assert config.credentials.key == paths.credentials / "robot.key"
    written = paths.proxy_config.stat().st_ino
    configuration.write_proxy_config(paths, identity(paths.folder), spec())
    assert paths.proxy_config.stat().st_ino == written, "it is left alone where nothing changes"


def test_where_each_process_answers_prometheus_is_passed_on(paths: PoolPaths) -> None:
    """To this machine's robot and to each replica; another robot's is not this machine's to say."""
    asked = dataclasses.replace(spec(), metrics=MetricsSpec("h:1", "h:2", "h:9470"))
    configuration.write_proxy_config(paths, identity(paths.folder), asked)
    assert read_client(paths.proxy_config).metrics == "h:1"
    assert read_client(paths.proxy_config, metrics="h:9").metrics == "h:9"
    other = configuration.proxy_config(identity(paths.folder), asked, name="other")
    (paths.folder / "other.yaml").write_text(other)
    assert read_client(paths.folder / "other.yaml").metrics == ""
    id = ReplicaId(UID, 3, 1)
    (paths.folder / "r.yaml").write_text(
        configuration.replica_config(identity(paths.folder), asked, id)
    )
    assert read_server(paths.folder / "r.yaml").metrics == "h:9473"


@pytest.mark.parametrize("run", ["exec serve", NASTY, "yes", "1", "null", ""])
def test_the_server_proxy_reads_what_was_written(paths: PoolPaths, run: str) -> None:
    """The user's command and environment arrive as the pool file has them, whatever they hold."""
    asked = spec(run=run, envs={"KEY": NASTY, "EMPTY": None, "NUMBER": 3})
    order = configuration.build_order(paths, identity(paths.folder), asked, planned(), b"signed")
    for name, content in order.files.items():
        (paths.folder / name).write_bytes(content)
    config = read_server(paths.folder / "replica.yaml", listen="127.0.0.1:5", domain_id=4)
    assert config.id == ReplicaId(UID, 3, 7)
    assert config.run == run
    assert config.envs == {"KEY": NASTY, "EMPTY": "", "NUMBER": "3"}
    assert [(s.name, s.type) for s in config.services] == [(s.name, s.type) for s in SERVICES]
    assert (config.listen, config.domain_id) == ("127.0.0.1:5", 4)
    described = authority.describe(config.credentials.certificate)
    assert described.common_name == f"replica.3.7.{UID}"
    assert described.role == authority.Role.REPLICA.value


def test_an_order_says_where_what_and_for_how_much(paths: PoolPaths) -> None:
    """The order carries the plan's placement, price and the spec's hash."""
    order = configuration.build_order(paths, identity(paths.folder), spec(), planned(), b"signed")
    assert (order.id, order.pool) == (ReplicaId(UID, 3, 7), "pool")
    assert order.placement == planned().offer.placement
    assert (order.usd_per_hour, order.spec_hash) == (0.25, spec().replica_hash)


def test_relative_paths_are_relative_to_the_pool_file() -> None:
    """Wherever the manager runs, `workdir: .` is the file's own folder; URLs are left alone."""
    task = {
        "workdir": ".",
        "file_mounts": {
            "/data": "data",
            "/s3": "s3://bucket/x",
            "/t": {"source": "x", "name": "t"},
        },
    }
    assert configuration.absolute(task, Path("/src/robot")) == {
        "workdir": "/src/robot",
        "file_mounts": {
            "/data": "/src/robot/data",
            "/s3": "s3://bucket/x",
            "/t": {"source": "/src/robot/x", "name": "t"},
        },
    }
    git = {"workdir": {"url": "https://example.org/x.git"}}
    assert configuration.absolute(git, Path("/src")) == git
    buckets = {"/l": {"source": ["a", "/b"]}, "/u": {"source": "gs://x"}, "/n": {"name": "n"}}
    several = configuration.absolute({"file_mounts": buckets}, Path("/src"))["file_mounts"]
    assert several == {**buckets, "/l": {"source": ["/src/a", "/b"]}}
    nobody = configuration.absolute({"file_mounts": {"/data": "~no-such-user/d"}}, Path("/src"))
    assert nobody == {"file_mounts": {"/data": "/src/~no-such-user/d"}}


def test_the_robots_certificate_is_made_once_and_renewed_in_time(paths: PoolPaths) -> None:
    """It lasts a year, is kept while it lasts, and is replaced two months before its end."""
    who, now = identity(paths.folder), datetime.datetime.now(datetime.timezone.utc)
    certificates = []
    for days in (0, 0, 300, 310):
        configuration.certify_robot(paths, who, now + datetime.timedelta(days=days))
        certificates.append((paths.credentials / "robot.crt").read_bytes())
    first, *kept, renewed = certificates
    assert kept == [first, first]
    assert renewed != first
    described = authority.describe(paths.credentials / "robot.crt")
    assert described.role == authority.Role.ROBOT.value
    assert described.common_name.startswith("robot.")
    assert described.common_name.endswith(UID)


def test_a_replicas_certificate_outlives_the_pool_and_a_margin(paths: PoolPaths) -> None:
    """A manager that died at the launch stops no traffic until the pool was to end anyway."""
    order = configuration.build_order(paths, identity(paths.folder), spec(), planned(), b"signed")
    said = authority.describe_pem(order.files["replica.crt"])
    lasts = said.not_after - datetime.datetime.now(datetime.timezone.utc)
    assert lasts > datetime.timedelta(days=30, hours=MAX_HOURS)


def test_of_two_rotations_at_once_key_and_certificate_are_of_the_same(
    paths: PoolPaths, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A key beside another's certificate opens no link, until somebody rotates again.

    The manager looks meanwhile: it waits, and does not rotate as well.
    """
    asked = paths, identity(paths.folder)
    replace, later = os.replace, list[Future[object]]()
    rotate = functools.partial(configuration.rotate_robot, *asked)
    now = datetime.datetime.now(datetime.timezone.utc)
    look = functools.partial(configuration.certify_robot, *asked, now)

    def replaced(temporary: str, path: Path) -> None:
        replace(temporary, path)
        if path.name == "robot.key" and not later:
            later.append(threads.submit(object))
            for step in (look, rotate):
                later.append(amid(threads, step, paths.credentials / "robot.lock"))

    with ThreadPoolExecutor(3) as threads:
        monkeypatch.setattr(os, "replace", replaced)
        rotate()
        for one in later:
            one.result()
    assert _common_name(paths).startswith(f"robot.{configuration.robot_name()}.2.")


def _common_name(paths: PoolPaths) -> str:
    return Signer(paths.credentials / "robot.crt", paths.credentials / "robot.key").common_name


@pytest.mark.parametrize("full", [True, False])
def test_a_rotation_that_fails_leaves_a_key_and_its_certificate(
    paths: PoolPaths, monkeypatch: pytest.MonkeyPatch, full: bool
) -> None:
    """On a full disk the old pair stays. What is killed in between, the manager rotates again."""
    asked = paths, identity(paths.folder)
    now = datetime.datetime.now(datetime.timezone.utc)
    configuration.certify_robot(*asked, now)
    before, make, replace = _common_name(paths), tempfile.mkstemp, os.replace

    def made(**how: Any) -> tuple[int, str]:
        if full and how["prefix"] == ".robot.crt.":
            raise OSError(28, "No space left on device")
        return make(**how)

    def replaced(temporary: str, path: Path) -> None:
        if path.name == "robot.crt":
            raise OSError(5, "Input/output error")
        replace(temporary, path)

    with monkeypatch.context() as patch:
        patch.setattr(tempfile, "mkstemp", made)
        patch.setattr(os, "replace", replaced)
        with pytest.raises(StateError, match=r"robot\.crt` cannot be written"):
            configuration.rotate_robot(*asked)
    assert not list(paths.credentials.glob(".*"))
    configuration.certify_robot(*asked, now)
    assert (_common_name(paths) == before) == full
