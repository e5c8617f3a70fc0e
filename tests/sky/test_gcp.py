"""GCP by its own interface, on a stand-in that answers as its REST reference describes."""

from __future__ import annotations

import importlib
import json
import re
import threading
import urllib.parse
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from fogft.cloud.sky import gcp
from fogft.cloud.sky.gcp import Gcp
from fogft.cloud.sky.provider import NotAllowedError
from fogft.errors import CloudUnreachable
from fogft.model.replica import ReplicaId
from tests.fakes import sky as scripted_sky
from tests.fakes.sky import replica
from tests.needs import needs

pytestmark = needs("skypilot")
PROJECT = "lab-1"
OTHER_POOL = "00000000000000bb"
_ASKED = re.compile(r"labels\.([a-z0-9_-]+)(:\*|=([a-z0-9_-]+))")


@dataclass
class Compute:
    """One project. Pages hold one zone, as small ones may; empty zones have GCP's warning."""

    machines: dict[str, dict[str, Any]] = field(default_factory=dict)  # by path below the project
    status: int = 200
    unreachable: str = ""  # a zone that cannot be asked

    def make(self, id: ReplicaId | None, zone: str, **more: Any) -> str:
        name = f"vm-{len(self.machines)}"
        labels = {"team": "arms"}
        if id is not None:
            labels |= scripted_sky.labels(id)
        url = f"https://www.googleapis.com/compute/v1/projects/{PROJECT}/zones/{zone}"
        self.machines[f"zones/{zone}/instances/{name}"] = {
            "name": name, "zone": url, "machineType": f"{url}/machineTypes/n2-standard-2",
            "status": "RUNNING", "labels": labels, "scheduling": {"provisioningModel": "SPOT"},
            "creationTimestamp": "2026-11-24T16:00:00.000-07:00",
            "networkInterfaces": [{"accessConfigs": [{"natIP": "1.2.3.4"}]}],
            **more,
        }  # fmt: skip
        return f"zones/{zone}/instances/{name}"

    def page(self, asked: dict[str, str]) -> dict[str, Any]:
        match = _ASKED.fullmatch(asked["filter"])
        assert match, asked
        zones = sorted({"zones/us-central1-a", "zones/us-east1-b", "zones/europe-west4-a"})
        number = int(asked.get("pageToken", "0"))
        zone = zones[number]
        mine = [
            one
            for path, one in self.machines.items()
            if path.startswith(f"{zone}/") and one["labels"].get(match[1]) in
            ([match[3]] if match[3] else one["labels"].values())
        ]  # fmt: skip
        code = "UNREACHABLE" if self.unreachable == zone else "NO_RESULTS_ON_PAGE"
        told = {"warning": {"code": code}} if not mine or code == "UNREACHABLE" else {}
        items = {zone: {**told, **({"instances": mine} if mine else {})}}
        following = {"nextPageToken": str(number + 1)} if number + 1 < len(zones) else {}
        return {"kind": "compute#instanceAggregatedList", "items": items, **following}

    def answer(self, method: str, path: str) -> tuple[int, dict[str, Any]]:
        if self.status != 200:
            return self.status, {"error": {"code": self.status, "message": "as GCP words it"}}
        url = urllib.parse.urlparse(path)
        below = url.path.removeprefix(f"/compute/v1/projects/{PROJECT}/")
        if method == "GET" and below == "aggregated/instances":
            return 200, self.page(dict(urllib.parse.parse_qsl(url.query)))
        if method == "DELETE" and self.machines.pop(below, None):
            return 200, {"kind": "compute#operation", "status": "RUNNING"}
        return 404, {"error": {"code": 404, "message": f"The resource '{below}' was not found"}}


@pytest.fixture
def compute(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Compute, Gcp]]:
    project = Compute()

    class Answers(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None: ...

        def do_GET(self) -> None:
            status, told = project.answer(self.command, self.path)
            body = json.dumps(told).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        do_DELETE = do_GET  # noqa: N815

    session = importlib.import_module("requests").Session()  # as google-auth's is one
    monkeypatch.setattr(gcp, "signed_in", lambda: (session, PROJECT))
    with ThreadingHTTPServer(("127.0.0.1", 0), Answers) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield project, Gcp(f"http://127.0.0.1:{server.server_port}/compute/v1/projects")
        server.shutdown()


def test_machines_of_ours_are_found_on_every_page_and_nothing_else_is(
    compute: tuple[Compute, Gcp],
):
    project, cloud = compute
    project.make(replica(1), "us-east1-b")
    project.make(replica(0), "us-central1-a")
    project.make(replica(0, uid=OTHER_POOL), "us-central1-a")
    project.make(None, "us-central1-a")
    found = cloud.instances(None, replica().pool_uid)
    assert [one.id for one in found] == [replica(0), replica(1)]
    place = found[0].placement
    assert (place.location, place.instance, place.spot) == (
        "gcp/us-central1/us-central1-a", "n2-standard-2", True
    )  # fmt: skip
    assert (found[0].public_ip, found[0].running) == ("1.2.3.4", True)
    assert found[0].launched_at == 1_795_561_200.0
    assert len(cloud.instances(None)) == 3
    assert [one.id for one in cloud.instances(["us-east1"])] == [replica(1)]
    assert not cloud.instances(())


def test_a_preempted_machine_is_listed_while_its_disk_costs(compute: tuple[Compute, Gcp]):
    """GCP stops what it preempts."""
    project, cloud = compute
    project.make(replica(), "us-east1-b", status="TERMINATED")
    (found,) = cloud.instances(None)
    assert not found.running


def test_terminate_ends_these_and_is_repeatable(compute: tuple[Compute, Gcp]):
    project, cloud = compute
    kept = project.make(replica(1), "us-east1-b")
    project.make(replica(0), "us-central1-a")
    (found,) = cloud.instances(["us-central1"])
    cloud.terminate(found)
    cloud.terminate(found)
    assert list(project.machines) == [kept]


@pytest.mark.parametrize(
    ("status", "expected"),
    [(403, NotAllowedError), (404, NotAllowedError), (401, CloudUnreachable),
     (429, CloudUnreachable), (503, CloudUnreachable)],
)  # fmt: skip
def test_not_allowed_is_not_the_same_as_cannot_tell(
    compute: tuple[Compute, Gcp], status: int, expected: type[Exception]
):
    project, cloud = compute
    project.status = status
    with pytest.raises(expected, match="as GCP words it"):
        cloud.instances(None)


def test_a_zone_that_cannot_be_asked_hides_no_machine(compute: tuple[Compute, Gcp]):
    project, cloud = compute
    project.make(replica(), "us-central1-a")
    project.unreachable = "zones/us-east1-b"
    with pytest.raises(CloudUnreachable, match="UNREACHABLE"):
        cloud.instances(None)


def test_no_network_is_cannot_tell(compute: tuple[Compute, Gcp]):
    with pytest.raises(CloudUnreachable, match="GCP did not answer"):
        Gcp("http://127.0.0.1:9/compute/v1/projects").instances(None)


def test_without_a_login_skypilots_word_has_to_do(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GOOGLE_APPLICATION_CREDENTIALS", "/nowhere.json")
    with pytest.raises(NotAllowedError, match="no GCP credentials"):
        Gcp().instances(None)
