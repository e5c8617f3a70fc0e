"""What fogft needs of SkyPilot, as a surface that a test can stand in for.

Plain values in and out: no object of SkyPilot's crosses this line. Every call has a limit
and ends in a value or in one of these errors, whatever SkyPilot, its API server and the
network do:

* `CloudUnreachable`: nothing is known, and nothing may be concluded;
* `RefusedError`: SkyPilot did the work and the answer is no, with its words.

Implementations: `fogft.cloud.sky.installed.InstalledSky`; `tests/sky/scripted_sky.py`, whose
calls are held to the installed SkyPilot's signatures by `tests/sky/test_installed.py`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol

from fogft.errors import CloudError
from fogft.model.replica import Offer, Placement


class RefusedError(CloudError):
    """SkyPilot answered, and the answer is no.

    Args:
        kind: Class name of its exception.
        texts: Its message, then those of its failover history.
    """

    def __init__(self, kind: str, texts: Sequence[str]) -> None:
        super().__init__(texts[0] if texts else kind)
        self.kind = kind
        self.texts = tuple(texts)


class RequestState(Enum):
    """How a request to the API server is doing."""

    ACTIVE = "active"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"


@dataclass(frozen=True)
class Request:
    """A launch request that the API server knows of."""

    id: str
    state: RequestState
    message: str = ""


class ClusterState(Enum):
    """SkyPilot's word for a cluster. What was terminated or preempted is not listed at all."""

    INIT = "INIT"  # being launched, or in a state that SkyPilot does not understand
    UP = "UP"
    STOPPED = "STOPPED"
    OTHER = "OTHER"


@dataclass(frozen=True)
class Cluster:
    """A record of SkyPilot's list.

    Attributes:
        placement: None while SkyPilot has not decided, or when it forgot.
        launched_at: Seconds since the epoch.
        progress: What SkyPilot says it is doing, or why the state is what it is.
    """

    name: str
    state: ClusterState
    placement: Placement | None = None
    head_ip: str = ""
    launched_at: float = 0.0
    progress: str = ""
    labels: Mapping[str, str] = field(default_factory=dict)


class JobState(Enum):
    """What became of the job that runs the server proxy."""

    PENDING = "pending"
    SETTING_UP = "setting up"
    RUNNING = "running"
    SETUP_FAILED = "setup failed"
    ENDED = "ended"
    MISSING = "missing"


class Sky(Protocol):
    """SkyPilot's public SDK, as far as fogft uses it. Calls come from any thread."""

    def launch(self, task: Mapping[str, Any], name: str) -> str:
        """Order a cluster; return the request's id, long before the cluster runs.

        Raises:
            CloudUnreachable: Unknown whether the order was heard.
            RefusedError: The task is not valid; nothing was ordered.
        """

    def launches(self, name: str) -> Sequence[Request]:
        """List the launch requests of a cluster that the API server knows, oldest first."""

    def request(self, id: str) -> Request | None:
        """Return how a request is doing; None when the API server does not know it."""

    def launched_job(self, id: str) -> int | None:
        """Return the job's number of a launch request that succeeded.

        Raises:
            RefusedError: The request failed, or was cancelled; carries why.
        """

    def cancel(self, id: str) -> None:
        """Abort a request; return when that is done. One that has ended is no error."""

    def clusters(self, name: str | None, *, refresh: bool) -> Sequence[Cluster]:
        """List one cluster, or all of them.

        Args:
            name: The only one of interest; None for all.
            refresh: Ask the clouds themselves (seconds), instead of SkyPilot's memory.
        """

    def job(self, name: str, number: int | None) -> JobState:
        """Return the state of a cluster's job, its last one if `number` is None."""

    def job_log(self, name: str, number: int | None, lines: int) -> str:
        """Return the end of a job's log; empty when there is none."""

    def provision_log(self, name: str, lines: int) -> str:
        """Return the end of the log of a cluster's launch; empty when there is none."""

    def down(self, name: str) -> None:
        """End a cluster; return when SkyPilot says that it is gone. Missing is no error.

        Raises:
            RefusedError: It failed; the cluster may still run.
        """

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """List what the catalogue sells for a `resources` section, cheapest first.

        Raises:
            RefusedError: The section is not valid.
        """

    def check(self, clouds: Sequence[str]) -> Mapping[str, str]:
        """Test the credentials of clouds, all if none is named: cloud -> "" or what is wrong."""
