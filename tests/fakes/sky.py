"""SkyPilot in memory: it keeps `installed.InstalledSky`'s surface and does what a test tells it to.

Launches stay under way until `finish`, `fail` or `cancel`. A machine can exist without a
record of SkyPilot's (`machines` of the fake provider), as after its database was lost.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from fogft.cloud.port import Launch
from fogft.cloud.sky import naming
from fogft.cloud.sky.provider import Instance, NotAllowedError
from fogft.cloud.sky.sdk import (
    Cluster,
    ClusterState,
    JobState,
    RefusedError,
    Request,
    Sale,
)
from fogft.errors import CloudError, CloudUnreachable
from fogft.model.replica import Offer, Placement, ReplicaId

EAST = Placement("aws", "us-east-1", "us-east-1a", "m6i.large")
WEST = Placement("aws", "us-west-2", "us-west-2a", "m6i.large")


@dataclass
class _Launch:
    request: Request
    name: str
    task: Mapping[str, Any]
    group: str = ""
    error: RefusedError | None = None
    job: int = 1


@dataclass
class ScriptedProvider:
    """A provider whose list is what really runs."""

    cloud: str = "aws"
    found: dict[str, Instance] = field(default_factory=dict)
    allowed: bool = True
    reachable: bool = True
    asked_regions: list[tuple[str, ...] | None] = field(default_factory=list)
    terminated: list[str] = field(default_factory=list)
    end_when_down: list[str] = field(default_factory=list)
    prices: dict[tuple[str, str], float] = field(default_factory=dict)
    mighty: str = ""
    ends_at: float | None = None
    quotas: dict[tuple[str, str], float] = field(default_factory=dict)

    def _meet(self) -> None:
        if not self.allowed:
            raise NotAllowedError("UnauthorizedOperation")
        if not self.reachable:
            raise CloudUnreachable("ExpiredToken")

    def instances(self, regions: Iterable[str] | None, pool_uid: str = "") -> Sequence[Instance]:
        self.asked_regions.append(None if regions is None else tuple(regions))
        self._meet()
        return [
            i
            for i in self.found.values()
            if pool_uid in ("", i.id.pool_uid)
            and (self.asked_regions[-1] is None or i.placement.region in self.asked_regions[-1])
        ]

    def terminate(self, instance: Instance) -> None:
        self._meet()
        self.terminated.append(instance.key)
        self.found.pop(instance.key, None)

    def end_when_shut_down(self, instance: Instance) -> None:
        self._meet()
        self.end_when_down.append(instance.key)

    def firewall(self, region: str, ports: Iterable[int], sources: Iterable[str]) -> str:
        self._meet()
        return f"{region} {sorted(ports)} {sorted(sources)}"

    def credentials_end_at(self) -> float | None:
        return self.ends_at

    def quota(self, region: str, code: str) -> float | None:
        self._meet()
        return self.quotas.get((region, code))

    def warning(self) -> str:
        return self.mighty

    def spot_prices(self, region: str, instances: Iterable[str]) -> Mapping[tuple[str, str], float]:
        self._meet()
        return {k: v for k, v in self.prices.items() if k[0].startswith(region)}


class ScriptedSky:
    """See the module. Has the surface of `InstalledSky`."""

    def __init__(self, provider: ScriptedProvider | None = None, *, boots: bool = False) -> None:
        self.provider = provider or ScriptedProvider()
        self.records: dict[str, Cluster] = {}
        self.jobs: dict[str, JobState] = {}
        self.job_logs: dict[str, str] = {}
        self.provision_logs: dict[str, str] = {}
        self.calls: list[tuple[str, str]] = []
        self.down_fails = 0  # so many times "down" returns an error
        self.down_lies = False  # "down" returns, and the machine runs on
        self.down_forgets = False  # "down" removes the record, and the machine runs on
        self.sold = [Offer(EAST, 0.02, "catalogue"), Offer(WEST, 0.03, "catalogue")]
        self.asked_for: Mapping[str, Any] = {}
        self.left_out: dict[str, str] = {}
        self.quotas: dict[tuple[str, bool], tuple[str, float]] = {}
        self.boots = boots  # whether a launch ends by itself when it is looked at
        self.full: set[str] = set()  # locations and types without capacity, for such launches
        self.unreachable = False
        self.credentials = {"aws": "", "gcp": "run `gcloud auth login`"}
        self.uploaded: list[str] | None = []
        self.server_told = ""
        self.mapped: dict[str, str] = {}  # cluster -> where its port is reached
        self.launched: list[_Launch] = []
        self.errors: dict[str, list[CloudError]] = {}
        self._counter = itertools.count(1)

    # -- the surface --------------------------------------------------------------------------

    def load(self) -> None:
        pass

    def launch(self, task: Mapping[str, Any], name: str, group: str = "") -> str:
        self._meet("launch", name)
        request = Request(f"r{next(self._counter)}", active=True)
        self.launched.append(_Launch(request, name, task, group))
        self._meet("launch-heard", name)
        return request.id

    def launches(self, name: str) -> Sequence[Request]:
        self._meet("launches", name)
        return [one.request for one in self.launched if one.name == name]

    def request(self, id: str) -> Request | None:
        self._meet("request", id)
        for one in self.launched:
            if one.request.id == id:
                if self.boots and one.request.active:
                    if one.task["resources"]["infra"] in self.full or not self._room(one.task):
                        self.fail(one.name, "ResourcesUnavailableError", "no spot capacity")
                    else:
                        self.finish(one.name)
                return one.request
        return None

    def launched_job(self, id: str) -> int | None:
        self._meet("launched_job", id)
        one = next(one for one in self.launched if one.request.id == id)
        if one.error is not None:
            raise one.error
        return one.job

    def cancel(self, id: str) -> None:
        self._meet("cancel", id)
        for one in self.launched:
            if one.request.id == id and one.request.active:
                one.request = replace(one.request, active=False)
                one.error = RefusedError("RequestCancelled", ["cancelled"])

    def clusters(self, name: str | None, *, refresh: bool) -> Sequence[Cluster]:
        self._meet("refresh" if refresh else "clusters", name or "")
        if refresh and name is not None and name in self.records and not self._runs(name):
            del self.records[name]
        return [c for c in self.records.values() if name in (None, c.name)]

    def job(self, name: str, number: int | None) -> JobState:
        self._meet("job", name)
        return self.jobs.get(name, JobState.MISSING)

    def endpoint(self, name: str, port: int) -> str:
        self._meet("endpoint", name)
        if name not in self.mapped:
            raise RefusedError("ValueError", ["not exposed"])
        return self.mapped[name]

    def job_log(self, name: str, number: int | None, lines: int) -> str:
        return self.job_logs.get(name, "")

    def provision_log(self, name: str, lines: int) -> str:
        return self.provision_logs.get(name, f"provisioning {name}")

    def stop(self, name: str) -> None:
        self._meet("stop", name)
        self.records[name] = replace(self.records[name], state=ClusterState.STOPPED)

    def down(self, name: str) -> None:
        self._meet("down", name)
        if self.down_fails:
            self.down_fails -= 1
            raise RefusedError("RuntimeError", ["failed to terminate"])
        if self.down_lies:
            return
        self.records.pop(name, None)
        if not self.down_forgets:
            self.preempt(name)

    def offers(self, resources: Mapping[str, Any]) -> Sale:
        self._meet("offers", "")
        self.asked_for = resources
        found = [o for o in self.sold if resources.get("region") in (None, o.placement.region)]
        return Sale(found, self.left_out, self.quotas)

    def lacking(self, resources: Mapping[str, Any]) -> Mapping[str, str]:
        self._meet("lacking", "")
        return {"aws": "", "lambda": "no spot machines" if resources.get("use_spot") else ""}

    def check(self, clouds: Sequence[str]) -> Mapping[str, str]:
        self._meet("check", "")
        return {c: self.credentials.get(c, "no such") for c in clouds or self.credentials}

    def renew_server(self) -> str:
        self._meet("renew_server", "")
        return self.server_told

    def uploaded_credentials(self, clouds: Sequence[str]) -> Sequence[str] | None:
        self._meet("uploaded_credentials", "")
        return self.uploaded

    # -- what tests do to it ------------------------------------------------------------------

    def fail_next(self, call: str, error: CloudError, times: int = 1) -> None:
        """Let the next calls raise. ``launch-heard`` raises after the order was taken."""
        self.errors.setdefault(call, []).extend([error] * times)

    def task(self, name: str) -> Mapping[str, Any]:
        """Return the task that a cluster was launched with."""
        return next(one.task for one in self.launched if one.name == name)

    def boot(self, name: str) -> None:
        """Let the machine exist, while its launch is still under way."""
        resources = self.task(name)["resources"]
        _, region, zone = resources["infra"].split("/")
        id = naming.replica_of(name)
        assert id is not None
        kind = (self._room(self.task(name)) or [""])[0]
        place = Placement("aws", region, zone, kind, resources["use_spot"])
        number = next(self._counter)
        self.preempt(name)  # a stopped one boots at another address
        self.records[name] = Cluster(
            name,
            ClusterState.INIT,
            place,
            f"10.0.0.{number}",
            1.0,
            "launching",
            resources["labels"],
        )
        self.provider.found[f"i-{number}"] = Instance(
            id, f"i-{number}", place, resources["labels"], f"10.0.0.{number}", 1.0
        )

    def queue(self, name: str, *, waits: bool = True) -> None:
        """Let a launch wait for a worker, or be taken by one."""
        one = self._of(name)
        one.request = replace(one.request, queued=waits)

    def finish(self, name: str, job: JobState = JobState.RUNNING) -> None:
        """Let a launch succeed."""
        if name not in self.records:
            self.boot(name)
        self.records[name] = replace(self.records[name], state=ClusterState.UP, progress="")
        self.jobs[name] = job
        one = self._of(name)
        one.request = replace(one.request, active=False)

    def fail(self, name: str, kind: str, *texts: str) -> None:
        """Let a launch fail; a machine that booted runs on, as with SkyPilot."""
        one = self._of(name)
        one.request = replace(one.request, active=False)
        one.error = RefusedError(kind, texts)

    def preempt(self, name: str) -> None:
        """Take the machine away; SkyPilot's record stays until it is refreshed."""
        id = naming.replica_of(name)
        for key in [k for k, i in self.provider.found.items() if i.id == id]:
            del self.provider.found[key]

    def forget_everything(self) -> None:
        """Lose SkyPilot's database."""
        self.records.clear()
        self.launched.clear()

    def asked(self, call: str) -> list[str]:
        """Return what a call was made about, in order."""
        return [subject for name, subject in self.calls if name == call]

    def _of(self, name: str) -> _Launch:
        return next(one for one in reversed(self.launched) if one.name == name)

    def _room(self, task: Mapping[str, Any]) -> list[str]:
        """Return the types that a task would take, and that are not full."""
        resources = task["resources"]
        kinds = [one["instance_type"] for one in resources.get("ordered", [resources])]
        return [kind for kind in kinds if kind not in self.full]

    def _runs(self, name: str) -> bool:
        id = naming.replica_of(name)
        return any(i.id == id for i in self.provider.found.values())

    def _meet(self, call: str, subject: str) -> None:
        if call != "launch-heard":
            self.calls.append((call, subject))
        if self.unreachable:
            raise CloudUnreachable("SkyPilot did not answer")
        if self.errors.get(call):
            raise self.errors[call].pop(0)


def labels(id: ReplicaId, usd_per_hour: float = 0.02) -> dict[str, str]:
    """Return the labels of a replica's machine."""
    return naming.labels(Launch(id, "p", EAST, usd_per_hour, "abcd"), "ann@robot")


def replica(slot: int = 0, generation: int = 1, uid: str = "00000000000000aa") -> ReplicaId:
    return ReplicaId(uid, slot, generation)
