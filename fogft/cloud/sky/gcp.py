"""GCP through its own API (REST, with google-auth, which comes with SkyPilot's GCP support).

Lists machines by our labels and deletes listed ones; implements nothing else of `provider`.
"""

import datetime
import importlib
import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from fogft.cloud.sky import naming
from fogft.cloud.sky.provider import Instance, NotAllowedError, Provider
from fogft.errors import CloudUnreachable
from fogft.model.replica import Placement

API = "https://compute.googleapis.com/compute/v1/projects"
_SCOPE = "https://www.googleapis.com/auth/cloud-platform"
_LIMIT_S = 10.0
_BEGINNING = frozenset(("PROVISIONING", "STAGING", "RUNNING", "REPAIRING"))


class Gcp(Provider):
    """GCP's own API; see `fogft.cloud.sky.provider.Provider`."""

    cloud = "gcp"

    def __init__(self, api: str = API) -> None:
        self._api = api
        self._lock = threading.Lock()
        self._known: tuple[Any, str] | None = None  # a session, and the project

    def instances(self, regions: Iterable[str] | None, pool_uid: str = "") -> Sequence[Instance]:
        """See `Provider`. Queries all zones at once; a preempted machine is listed as stopped."""
        where = None if regions is None else set(regions)
        if where is not None and not where:
            return []
        wanted = f"labels.{naming.POOL}={pool_uid}" if pool_uid else f"labels.{naming.POOL}:*"
        found, page = [], ""
        while True:
            asked = {"filter": wanted, "maxResults": 500, **({"pageToken": page} if page else {})}
            answer = self._ask("GET", "aggregated/instances", asked)
            for scope, told in (answer.get("items") or {}).items():
                code = (told.get("warning") or {}).get("code", "NO_RESULTS_ON_PAGE")
                if code != "NO_RESULTS_ON_PAGE":
                    raise CloudUnreachable(f"GCP did not answer about `{scope}`: {code}")
                found += [_instance(raw) for raw in told.get("instances") or ()]
            page = answer.get("nextPageToken") or ""
            if not page:
                break
        ours = [i for i in found if i and (where is None or i.placement.region in where)]
        return sorted(ours, key=lambda i: (i.id, i.key))

    def terminate(self, instance: Instance) -> None:
        """See `Provider`."""
        self._ask("DELETE", instance.key)

    def _ask(self, method: str, path: str, asked: Any = None) -> Mapping[str, Any]:
        try:
            with self._lock:
                self._known = self._known or signed_in()
                session, project = self._known
            url = f"{self._api}/{project}/{path}"
            answer = session.request(method, url, params=asked, timeout=_LIMIT_S)
            told = answer.json() if answer.content else {}
        except NotAllowedError:
            raise
        except Exception as error:  # the network, an expired login, no JSON
            with self._lock:  # only a new session reads renewed credentials
                self._known = None
            hint = "renew the GCP credentials; `sky check gcp` tests them"
            raise CloudUnreachable(f"GCP did not answer: {error}", hint) from error
        status = answer.status_code
        if status < 400 or (method == "DELETE" and status == 404):
            return dict(told)
        words = f"{status}: {(told.get('error') or {}).get('message', '')}"
        if status in (403, 404):
            raise NotAllowedError(words)
        raise CloudUnreachable(f"GCP did not answer: {words}")


def signed_in() -> tuple[Any, str]:
    """Return a session with this computer's credentials, and the project that SkyPilot uses."""
    try:
        auth = importlib.import_module("google.auth")
        transport = importlib.import_module("google.auth.transport.requests")
        credentials, _ = auth.default(scopes=[_SCOPE])
        project = importlib.import_module("sky.clouds").GCP.get_project_id()
    except Exception as error:  # not installed, or nobody has logged in
        raise NotAllowedError(f"there are no GCP credentials: {error}") from error
    return transport.AuthorizedSession(credentials), str(project)


def _instance(raw: Mapping[str, Any]) -> Instance | None:
    labels = dict(raw.get("labels") or {})
    id = naming.replica_of_labels(labels)
    if id is None:
        return None
    zone, kind = (str(raw.get(key, "")).rpartition("/")[2] for key in ("zone", "machineType"))
    spot = (raw.get("scheduling") or {}).get("provisioningModel") == "SPOT"
    cards = raw.get("networkInterfaces") or ()
    public = [one.get("natIP", "") for card in cards for one in card.get("accessConfigs") or ()]
    made = str(raw.get("creationTimestamp", ""))
    return Instance(
        id=id,
        key=f"zones/{zone}/instances/{raw['name']}",
        placement=Placement("gcp", zone.rpartition("-")[0], zone, kind, spot),
        labels=labels,
        public_ip=next(filter(None, public), ""),
        launched_at=datetime.datetime.fromisoformat(made).timestamp() if made else 0.0,
        running=raw.get("status") in _BEGINNING,
    )
