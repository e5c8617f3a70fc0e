"""The plain values that SkyPilot's answers become: no object of its own gets past `installed`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

from fogft.cloud.sky.failures import classify
from fogft.errors import CloudError
from fogft.model.replica import Offer, Placement


class RefusedError(CloudError):
    """SkyPilot answered, and the answer is no; see `classify`."""

    def __init__(self, kind: str, texts: Sequence[str]) -> None:
        super().__init__(texts[0] if texts else kind)
        self.kind = kind
        self.texts = tuple(texts)
        self.reason = classify(kind, texts)


@dataclass(frozen=True)
class Request:
    """A launch request that the API server knows of, and whether it is still under way.

    Attributes:
        queued: No worker has begun with it: a local server on two cores has two.
    """

    id: str
    active: bool
    queued: bool = False


class ClusterState(Enum):
    """SkyPilot's word for a cluster. What was terminated or preempted is not listed at all."""

    INIT = "INIT"  # being launched, or in a state that SkyPilot does not understand
    UP = "UP"
    STOPPED = "STOPPED"
    OTHER = "OTHER"


@dataclass(frozen=True)
class Cluster:
    """A record of SkyPilot's list."""

    name: str
    state: ClusterState
    placement: Placement | None = None  # none while SkyPilot has not decided, or when it forgot
    head_ip: str = ""
    launched_at: float = 0.0  # seconds since the epoch
    progress: str = ""  # what SkyPilot says it is doing, or why the state is what it is
    labels: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Sale:
    """What SkyPilot could launch for a `resources` section.

    Attributes:
        offers: Of each location several machines that would do, at the catalogue's prices.
        left_out: Cloud -> why no such machine can be launched there.
        vcpus: Instance type -> how many it has, which quotas are about.
        quotas: Instance type and whether spot -> the provider's code of the quota.
    """

    offers: Sequence[Offer]
    left_out: Mapping[str, str] = field(default_factory=dict)
    vcpus: Mapping[str, float] = field(default_factory=dict)
    quotas: Mapping[tuple[str, bool], str] = field(default_factory=dict)


class JobState(Enum):
    """What became of the job that runs the server proxy."""

    PENDING = "pending"
    SETTING_UP = "setting up"
    RUNNING = "running"
    SETUP_FAILED = "setup failed"
    ENDED = "ended"
    MISSING = "missing"
