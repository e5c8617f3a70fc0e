"""The proxies' configuration files: what they hold, and how they are read.

Both are YAML that a person can read, rendered by the manager from `templates/`. Paths in
them are relative to the file's own folder.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fogft.cloud import notice
from fogft.errors import StateError
from fogft.link.frame import ROBOT_BYTES_LIMIT
from fogft.model import names
from fogft.model.credentials import CredentialPaths
from fogft.model.endpoint import is_endpoint
from fogft.model.middleware import Speaks
from fogft.model.replica import ReplicaId
from fogft.model.spec import ServiceSpec
from fogft.model.topic import TopicSpec
from fogft.model.uplinks import is_interface
from fogft.poolfile.service_form import from_plain, seconds

DEFAULT_GATEWAY_LISTEN = "0.0.0.0:7470"


@dataclass(frozen=True)
class ClientProxyConfig:
    """All that `fogft proxy` needs to know.

    Attributes:
        rendezvous: ``host:port`` of each.
        records: File that keeps what was learned there.
        revocations: The manager's signed revocations, to be passed on to replicas.
        dial_in: ``host:port`` that replicas which cannot be reached are told; empty for none.
        dial_in_listen: Where to listen for them; empty for that port on all addresses.
        uplinks: Network interfaces, the preferred one first; none for what the routes say.
        metrics: ``host:port`` to answer Prometheus at; empty for none.
        topics: What passes besides services.
        rmw: How it speaks ROS.
    """

    pool: str
    pool_uid: str
    robot: str
    membership: Path
    status: Path
    lease: Path
    lock: Path
    credentials: CredentialPaths
    services: tuple[ServiceSpec, ...]
    suspect_after_s: float = 2.0
    tell_losers: bool = True
    domain_id: int | None = None
    rendezvous: tuple[str, ...] = ()
    records: Path | None = None
    revocations: Path | None = None
    dial_in: str = ""
    dial_in_listen: str = ""
    uplinks: tuple[str, ...] = ()
    metrics: str = ""
    topics: tuple[TopicSpec, ...] = ()
    rmw: Speaks = Speaks.RCLPY


@dataclass(frozen=True)
class GatewayConfig:
    """All that `fogft gateway` needs to know: a client proxy's, and where robots reach it.

    Attributes:
        listen: ``host:port``.
    """

    client: ClientProxyConfig
    listen: str


@dataclass(frozen=True)
class ServerProxyConfig:
    """All that `fogft serve` needs to know.

    Attributes:
        advertise: ``host:port`` at which this replica is reached, where it was told.
        rendezvous: ``host:port`` of each.
        records: File that keeps what was learned there.
        dial_out: Doors of robots and gateways, where this replica cannot be reached.
        rmw: How it speaks ROS.
        notice: Where preemption notices come from: ``none``, ``file:PATH`` with an absolute
            path, or a source of `fogft.cloud.notice.watch`.
        metrics: ``host:port`` to answer Prometheus at; empty for none.
        topics: What passes besides services.
    """

    pool: str
    id: ReplicaId
    listen: str
    services: tuple[ServiceSpec, ...]
    run: str
    workdir: Path
    credentials: CredentialPaths
    envs: Mapping[str, str] = field(default_factory=dict)
    domain_id: int | None = None
    orphan_after_s: float = 3600.0
    notice: str = "auto"
    max_in_flight: int = 512
    log_level: str = "info"
    advertise: str = ""
    rendezvous: tuple[str, ...] = ()
    records: Path | None = None
    dial_out: tuple[str, ...] = ()
    metrics: str = ""
    topics: tuple[TopicSpec, ...] = ()
    rmw: Speaks = Speaks.RCLPY


def read_client(path: Path, metrics: str | None = None) -> ClientProxyConfig:
    """Read a client proxy's configuration; `metrics` replaces what it says.

    Raises:
        StateError: It cannot be read, or a key is missing or of the wrong type.
    """
    with _Reading(path) as (raw, base):
        return _client({**raw, **({} if metrics is None else {"metrics": metrics})}, base)
    raise AssertionError("unreachable")


def _client(raw: Mapping[str, Any], base: Path) -> ClientProxyConfig:
    return ClientProxyConfig(
        pool=str(raw["pool"]),
        pool_uid=_uid(raw["pool_uid"]),
        robot=_robot(raw["robot"]),
        membership=base / raw["membership"],
        status=base / raw["status"],
        lease=base / raw["lease"],
        lock=base / raw["lock"],
        credentials=_credentials(raw["credentials"], base),
        services=tuple(from_plain(s) for s in raw["services"]),
        suspect_after_s=seconds((raw.get("health") or {}).get("suspect_after_s") or 2.0),
        domain_id=_optional_int(raw.get("domain_id")),
        tell_losers=bool(raw.get("tell_losers", True)),
        rendezvous=_endpoints(raw.get("rendezvous")),
        records=base / raw["records"] if raw.get("records") else None,
        revocations=base / raw["revocations"] if raw.get("revocations") else None,
        dial_in=_endpoint(raw.get("dial_in") or ""),
        dial_in_listen=_endpoint(raw.get("dial_in_listen") or ""),
        uplinks=_interfaces(raw.get("uplinks")),
        metrics=_endpoint(raw.get("metrics") or ""),
        topics=tuple(TopicSpec.from_plain(t) for t in raw.get("topics") or ()),
        rmw=_speaks(raw),
    )


def read_gateway(
    path: Path, listen: str | None = None, metrics: str | None = None
) -> GatewayConfig:
    """Read a gateway's configuration; `listen` and `metrics` replace what it says.

    Raises:
        StateError: It cannot be read, or a key is missing or of the wrong type.
    """
    with _Reading(path) as (raw, base):
        given = {**raw, **({} if metrics is None else {"metrics": metrics})}
        return GatewayConfig(
            client=_client({**given, "robot": raw["gateway"]}, base),
            listen=listen or str(raw.get("listen") or DEFAULT_GATEWAY_LISTEN),
        )
    raise AssertionError("unreachable")


def read_server(path: Path, **override: Any) -> ServerProxyConfig:
    """Read a server proxy's configuration; options that are not None replace what it says.

    Raises:
        StateError: It cannot be read, or a key is missing or of the wrong type.
    """
    with _Reading(path) as (in_file, base):
        raw = {**in_file, **{key: value for key, value in override.items() if value is not None}}
        return ServerProxyConfig(
            pool=str(raw["pool"]),
            id=ReplicaId(_uid(raw["pool_uid"]), int(raw["slot"]), int(raw["generation"])),
            listen=str(raw.get("listen") or "0.0.0.0:7447"),
            services=tuple(from_plain(s) for s in raw["services"]),
            run=str(raw["run"]),
            workdir=base / (raw.get("workdir") or "."),
            credentials=_credentials(raw["credentials"], base),
            envs={str(k): str(v) for k, v in (raw.get("envs") or {}).items()},
            domain_id=_optional_int(raw.get("domain_id")),
            orphan_after_s=seconds(raw.get("orphan_after_s") or 3600.0),
            notice=_notice(raw.get("notice"), base),
            max_in_flight=int(raw.get("max_in_flight") or 512),
            log_level=str(raw.get("log_level") or "info"),
            advertise=_endpoint(raw.get("advertise") or ""),
            rendezvous=_endpoints(raw.get("rendezvous")),
            records=base / raw["records"] if raw.get("records") else None,
            dial_out=_endpoints(raw.get("dial_out")),
            metrics=_endpoint(raw.get("metrics") or ""),
            topics=tuple(TopicSpec.from_plain(t) for t in raw.get("topics") or ()),
            rmw=_speaks(raw),
        )
    raise AssertionError("unreachable")


class _Reading:
    """Turn whatever goes wrong while a configuration is read into one clear error."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> tuple[dict[str, Any], Path]:
        import yaml

        try:
            raw = yaml.safe_load(self._path.read_text())
        except Exception as error:  # PyYAML passes on what its constructors raise
            raise StateError(f"`{self._path}` cannot be read: {error}") from error
        if not isinstance(raw, dict):
            raise StateError(f"`{self._path}` is not a configuration: it holds no keys")
        return raw, self._path.resolve().parent

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        hint = "it is written by `fogft up`; run that again, or compare it with `templates/`"
        if isinstance(error, KeyError):
            raise StateError(f"`{self._path}`: key {error} is missing", hint) from error
        if isinstance(error, (TypeError, ValueError, OverflowError, AttributeError)):
            raise StateError(f"`{self._path}` is not usable: {error}", hint) from error


def _credentials(raw: Mapping[str, str], base: Path) -> CredentialPaths:
    return CredentialPaths(base / raw["ca"], base / raw["certificate"], base / raw["key"])


def _speaks(raw: Mapping[str, Any]) -> Speaks:
    speaks = Speaks(raw.get("rmw") or Speaks.RCLPY)
    if speaks is Speaks.ZENOH and raw.get("topics"):
        raise ValueError("rmw: zenoh passes services only; it has topics")
    return speaks


def _endpoints(raw: Any) -> tuple[str, ...]:
    if raw is not None and not isinstance(raw, list):
        raise ValueError(f"{raw!r:.40} is not a list of endpoints")
    return tuple(_endpoint(one) for one in raw or ())


def _interfaces(raw: Any) -> tuple[str, ...]:
    if raw is None:
        return ()
    if not isinstance(raw, list) or not all(isinstance(o, str) and is_interface(o) for o in raw):
        raise ValueError(f"{raw!r:.40} is not a list of network interfaces")
    return tuple(dict.fromkeys(raw))


def _endpoint(raw: Any) -> str:
    if not isinstance(raw, str) or (raw and not is_endpoint(raw)):
        raise ValueError(f"{raw!r:.40} is not `host:port`")
    return raw


def _uid(raw: Any) -> str:
    if not isinstance(raw, str) or not names.POOL_UID_PATTERN.fullmatch(raw):
        raise ValueError(f"{raw!r:.40} is not a pool's uid: quote 16 hexadecimal digits")
    return raw


def _robot(raw: Any) -> str:
    robot = str(raw)
    if not robot.isprintable() or not 0 < len(robot.encode()) <= ROBOT_BYTES_LIMIT:
        raise ValueError(f"a robot's name has 1 to {ROBOT_BYTES_LIMIT} printable bytes")
    return robot


def _notice(raw: Any, base: Path) -> str:
    source = "auto" if raw is None else str(raw)
    kind, colon, path = source.partition(":")
    if colon and kind == "file" and path:
        return f"file:{base / path}"
    if source != "none" and source not in notice.SOURCES:
        known = ", ".join(("file:PATH", "none", *notice.SOURCES))
        raise ValueError(f"notice: {raw!r:.40} is none of {known}")
    return source


def _optional_int(raw: Any) -> int | None:
    return None if raw is None else int(raw)
