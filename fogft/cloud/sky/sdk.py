"""Plain values for SkyPilot's answers and errors. Pure.

SkyPilot's own objects do not leave `installed`. The key distinction is between "unknown" (API
server, network or credentials failed) and "the answer is no": conclude nothing from the first.
"""

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from fogft.cloud.sky.failures import classify, plain
from fogft.errors import CloudError, CloudUnreachable
from fogft.model.replica import Offer, Placement


class RefusedError(CloudError):
    """SkyPilot refused a request; see `classify`."""

    def __init__(self, kind: str, texts: Sequence[str]) -> None:
        super().__init__(texts[0] if texts else kind)
        self.kind = kind
        self.texts = tuple(texts)
        self.reason = classify(kind, texts)


@dataclass(frozen=True)
class Request:
    """A launch request that the API server knows. `queued`: no worker has started on it."""

    id: str
    active: bool
    queued: bool = False


class ClusterState(Enum):
    """SkyPilot's state of a cluster. Terminated and preempted clusters are not listed at all."""

    INIT = "INIT"  # being launched, or in a state that SkyPilot does not understand
    UP = "UP"
    STOPPED = "STOPPED"
    OTHER = "OTHER"


@dataclass(frozen=True)
class Cluster:
    """A cluster in SkyPilot's list."""

    name: str
    state: ClusterState
    placement: Placement | None = None  # None if SkyPilot has not decided yet, or has forgotten
    head_ip: str = ""
    launched_at: float = 0.0  # seconds since the epoch
    progress: str = ""  # SkyPilot's current activity, or the reason for the state
    labels: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Sale:
    """The offers that SkyPilot has for a `resources` section."""

    offers: Sequence[Offer]  # several that match in each location, at the catalogue's prices
    left_out: Mapping[str, str] = field(default_factory=dict)  # cloud -> why it has no offers
    # (instance type, whether spot) -> the quota's code, and how many vCPUs the machine needs.
    quotas: Mapping[tuple[str, bool], tuple[str, float]] = field(default_factory=dict)


class JobState(Enum):
    """The state of the job that runs the server proxy."""

    PENDING = "pending"
    SETTING_UP = "setting up"
    RUNNING = "running"
    SETUP_FAILED = "setup failed"
    ENDED = "ended"
    MISSING = "missing"


# Errors that mean "unknown": of the server, the network or the credentials, not the cluster.
UNKNOWN = frozenset(
    (
        *("ApiServerConnectionError", "ApiServerAuthenticationError", "APIVersionMismatchError"),
        *("ServerTemporarilyUnavailableError", "RequestInterruptedError", "NetworkError"),
        *("ClusterStatusFetchingError", "FetchClusterInfoError", "KubeAPIUnreachableError"),
        *("ConcurrentWorkerExhaustedError", "ExecutionRetryableError", "ExecutionPoolFullError"),
        *("SkyletUnavailableError", "CloudUserIdentityError", "InvalidCloudCredentials"),
        *("NoCloudAccessError", "CloudError"),
        *("ConnectionError", "ConnectTimeout", "ReadTimeout", "Timeout", "TimeoutError"),
        *("HTTPError", "ChunkedEncodingError"),
    )
)
JOBS = {
    "INIT": JobState.PENDING, "PENDING": JobState.PENDING, "SETTING_UP": JobState.SETTING_UP,
    "RUNNING": JobState.RUNNING, "FAILED_SETUP": JobState.SETUP_FAILED,
}  # fmt: skip


ENDED = frozenset(("SUCCEEDED", "FAILED", "CANCELLED"))
_QUEUED = frozenset(("PENDING", "WAITING"))
_CREDENTIALS = ("NoCloudAccessError", "CloudUserIdentityError", "InvalidCloudCredentials")


def translated(error: BaseException, subject: str) -> CloudError:
    """Convert an exception from SkyPilot to `CloudUnreachable` or `RefusedError`."""
    if isinstance(error, CloudError):
        return error
    kind = type(error).__name__
    if _is_unknown(error):
        words = plain(str(error)) or kind
        return CloudUnreachable(f"SkyPilot did not answer about {subject}: {words}", _hint(kind))
    return RefusedError(kind, _texts(error))


@contextlib.contextmanager
def as_answer() -> Iterator[None]:
    """Convert exceptions to `RefusedError`, except those that mean "unknown"."""
    try:
        yield
    except Exception as error:
        kind = type(error).__name__
        said_by_server = kind == "CloudError" or kind in _CREDENTIALS
        if _is_unknown(error) and not said_by_server:
            raise
        raise RefusedError(kind, _texts(error)) from error


def _is_unknown(error: BaseException) -> bool:
    if type(error).__name__ in UNKNOWN or isinstance(error, OSError):
        return True
    # SkyPilot's `get` raises a bare RuntimeError for some failures of the API server.
    return type(error) is RuntimeError and str(error).startswith(
        ("Failed to get request", "Failed to connect", "SkyPilot API server")
    )


def _texts(error: BaseException) -> list[str]:
    history = getattr(error, "failover_history", None) or []
    return [plain(str(text)) for text in (error, *history)]


def _hint(kind: str) -> str:
    if kind in _CREDENTIALS:
        return (
            "renew the credentials of this cloud; `sky check` tests them. SkyPilot's API server "
            "keeps running: `sky api stop` ends it"
        )
    if kind in ("ConnectionError", "ConnectTimeout", "MaxRetryError", "NameResolutionError"):
        return "check that this machine reaches the internet; `sky check` tests each cloud"
    if kind == "APIVersionMismatchError":
        return "the API server has a different version: run `sky api stop` once it is idle"
    return "`sky api info` and `sky check` show what is wrong"


def cluster_of(record: Any) -> Cluster:
    """Convert SkyPilot's `StatusResponse` to a `Cluster`."""
    state = getattr(record.status, "value", str(record.status))
    chosen = getattr(record.handle, "launched_resources", None)
    placement = None
    if chosen is not None and chosen.cloud is not None and chosen.region is not None:
        placement = Placement(
            str(chosen.cloud).lower(),
            chosen.region,
            chosen.zone or "",
            chosen.instance_type or "",
            bool(chosen.use_spot),
        )
    return Cluster(
        name=record.name,
        state=ClusterState(state) if state in ClusterState.__members__ else ClusterState.OTHER,
        placement=placement,
        head_ip=getattr(record.handle, "head_ip", None) or "",
        launched_at=float(record.launched_at or 0.0),
        progress=plain(record.init_status_reason or record.last_event or ""),
        labels=dict(record.labels or getattr(chosen, "labels", None) or {}),
    )


def request_of(payload: Any) -> Request:
    """Convert SkyPilot's `RequestPayload` to a `Request`."""
    return Request(
        payload.request_id, active=payload.status not in ENDED, queued=payload.status in _QUEUED
    )


def told_reasons(output: str) -> dict[str, str]:
    """Return cloud -> reason for the unusable clouds in the output of ``sky check``."""
    reasons: dict[str, str] = {}
    cloud = ""
    for line in map(plain, output.splitlines()):
        heading = re.fullmatch(r"(\w[\w ]*): (enabled|disabled).*", line)
        if heading:
            cloud = heading[1].lower() if heading[2] == "disabled" else ""
        elif not line:  # what follows is about no cloud
            cloud = ""
        elif cloud and not line.startswith("For more info"):
            text = re.sub(r"^Reason \[[^]]*\]: ", "", line)
            reasons[cloud] = " ".join(part for part in (reasons.get(cloud, ""), text) if part)
    return reasons
