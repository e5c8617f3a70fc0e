"""The SDK of the installed SkyPilot, which is imported on first use.

Importing it takes 2 to 4 s, and the first call may start its API server (11 s, 0.6 GB); a remote
server is selected with `SKYPILOT_API_SERVER_ENDPOINT` or ``sky api login``, as usual.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib
import io
import logging
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from typing import Any, TypeVar, cast

from fogft.cloud.sky import catalogue
from fogft.cloud.sky.naming import replica_of
from fogft.cloud.sky.sdk import (
    JOBS,
    Cluster,
    JobState,
    RefusedError,
    Request,
    Sale,
    as_answer,
    cluster_of,
    request_of,
    told_reasons,
    translated,
)
from fogft.cloud.sky.settings import NO_REPORTS, Settings
from fogft.errors import CloudError, CloudUnreachable
from fogft.model.names import VM_CLOUDS
from fogft.process import on_thread

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

ASK_LIMIT_S = 30.0
REFRESH_LIMIT_S = 60.0
CHECK_LIMIT_S = 300.0  # asks every cloud, and may start the API server: minutes on a busy machine
JOB_LIMIT_S = 120.0  # starts a Python on the machine, over ssh
LAUNCH_LIMIT_S = 120.0  # uploads `workdir` and `file_mounts`, and may start the API server
DOWN_LIMIT_S = 300.0
_FORGOTTEN = 10  # times the limit: SkyPilot waits forever for an answer that a router lost


def _run(call: Callable[[], T], outcome: Future[T]) -> None:
    try:
        outcome.set_result(call())
    except BaseException as error:  # SystemExit too: SkyPilot's client raises it
        outcome.set_exception(error)


def _limited(limit_s: float, subject: str) -> Callable[[F], F]:
    """Give a call a time limit; `subject` describes it, with its arguments filled in."""

    def decorate(call: F) -> F:
        @functools.wraps(call)
        def limited(self: InstalledSky, *args: Any) -> Any:
            def run() -> Any:
                self.load()
                return call(self, *args)

            return self.within(limit_s, subject.format(*args), run)

        return cast(F, limited)

    return decorate


class InstalledSky:
    """The part of SkyPilot's public SDK that fogft uses. Thread-safe.

    Every call has a time limit. It returns a value, or raises `CloudUnreachable` if the answer is
    unknown (conclude nothing) or `RefusedError` if the answer is no.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.sky: Any = None  # the two modules, once loaded
        self.sdk: Any = None
        self._given_up: dict[str, tuple[Future[Any], float]] = {}  # by subject, with its start
        self._settings = Settings()

    def within(self, limit_s: float, subject: str, call: Callable[[], T]) -> T:
        """Run a call on its own thread with a timeout, which SkyPilot's client lacks.

        A call that timed out still runs, here and on the API server. Until it ends, or must have
        been lost, the same call (`subject`) is not made again; a late answer is dropped.
        """
        ends_at = time.monotonic() + limit_s
        running, begun_at = self._given_up.get(subject, (None, 0.0))
        if time.monotonic() - begun_at > _FORGOTTEN * limit_s:
            running = None
        if running is not None:
            wait([running], limit_s)
        if running is None or running.done():
            running, begun_at = Future(), time.monotonic()
            try:
                on_thread(_run, call, running)
            except OSError as lack:
                raise CloudUnreachable(f"SkyPilot cannot be asked: {lack}") from lack
            wait([running], max(0.0, ends_at - time.monotonic()))
            if running.done():
                self._given_up.pop(subject, None)
                error = running.exception()
                if error is not None:
                    raise translated(error, subject) from error
                answer: T = running.result()
                return answer
        self._given_up[subject] = running, begun_at
        raise CloudUnreachable(
            f"SkyPilot did not answer within {limit_s:.0f} s about {subject}",
            "`sky api info` and `sky api logs` show the state of its API server",
        )

    @_limited(LAUNCH_LIMIT_S, "the launch of `{1}`")
    def launch(self, task: Mapping[str, Any], name: str, group: str = "") -> str:
        """Launch a cluster; return the request's id before it runs. `group`: AWS security group."""
        with as_answer():
            made = self.sky.Task.from_yaml_config(dict(task))
        cloud = str((task.get("resources") or {}).get("infra", "")).split("/")[0]
        self._settings.apply([cloud], replica_of(name), group)
        return str(self.sdk.launch(made, cluster_name=name))

    @_limited(ASK_LIMIT_S, "the requests of `{0}`")
    def launches(self, name: str) -> Sequence[Request]:
        """List the launch requests of a cluster that the API server knows, oldest first."""
        found = self._asked(all_status=True, cluster_name=name)
        found = [r for r in found if r.name == "sky.launch" and r.cluster_name == name]
        return [request_of(r) for r in sorted(found, key=lambda r: r.created_at)]

    @_limited(ASK_LIMIT_S, "request {0}")
    def request(self, id: str) -> Request | None:
        """Return a request's state; None if the API server does not know it."""
        found = self._asked(request_ids=[id])
        return next((request_of(r) for r in found if r.request_id == id), None)

    @_limited(ASK_LIMIT_S, "the outcome of request {0}")
    def launched_job(self, id: str) -> int | None:
        """Return the job number of a launch request. RefusedError: it failed or was cancelled."""
        with as_answer():
            job, _ = self.sdk.get(id)
        return None if job is None else int(job)

    @_limited(ASK_LIMIT_S, "the abort of request {0}")
    def cancel(self, id: str) -> None:
        """Abort a request; return when that is done. No error if it has already ended."""
        self.sdk.get(self.sdk.api_cancel([id], silent=True))

    def clusters(self, name: str | None, *, refresh: bool) -> Sequence[Cluster]:
        """List one cluster, or all for None. `refresh` asks the clouds: it takes seconds."""

        def run() -> Sequence[Cluster]:
            self.load()
            modes = self.sky.StatusRefreshMode
            mode = modes.FORCE if refresh else modes.NONE
            names = None if name is None else [name]
            # All users: whoever lost `~/.sky/user_hash` is another user to SkyPilot, but still
            # pays for the machines. The pool's uid tells machines apart.
            found = self.sdk.get(self.sdk.status(names, refresh=mode, all_users=True))
            return [cluster_of(record) for record in found]

        limit_s = REFRESH_LIMIT_S if refresh else ASK_LIMIT_S
        subject = f"cluster `{name}`" if name else "the list of clusters"
        return self.within(limit_s, subject, run)

    @_limited(JOB_LIMIT_S, "the job of `{0}`")
    def job(self, name: str, number: int | None) -> JobState:
        """Return the state of a cluster's job, its last one if `number` is None."""
        states = self.sdk.get(self.sdk.job_status(name, None if number is None else [number]))
        state = next(iter(states.values()), None)
        return JobState.MISSING if state is None else JOBS.get(state.value, JobState.ENDED)

    @_limited(ASK_LIMIT_S, "the address of `{0}`")
    def endpoint(self, name: str, port: int) -> str:
        """Return the ``host:port`` of a cluster's port. RefusedError: it is not mapped yet."""
        with as_answer():
            found = self.sdk.get(self.sdk.endpoints(name, port))
        told = {int(key): str(value) for key, value in found.items()}
        if not told.get(port):
            raise RefusedError("ValueError", [f"port {port} of `{name}` is not mapped"])
        return told[port].rpartition("//")[2]

    def job_log(self, name: str, number: int | None, lines: int) -> str:
        """Return the end of a job's log; empty when there is none."""
        return self._log(lines, lambda **how: self.sdk.tail_logs(name, number, **how))

    def provision_log(self, name: str, lines: int) -> str:
        """Return the end of the log of a cluster's launch; empty when there is none."""
        return self._log(lines, lambda **how: self.sdk.tail_provision_logs(name, **how))

    @_limited(DOWN_LIMIT_S, "the stop of `{0}`")
    def stop(self, name: str) -> None:
        """Stop a cluster; return when SkyPilot says that it has stopped."""
        with as_answer():
            self.sdk.get(self.sdk.stop(name))

    @_limited(DOWN_LIMIT_S, "the end of `{0}`")
    def down(self, name: str) -> None:
        """Terminate a cluster; return when SkyPilot says it is gone. No error if it is missing."""
        try:
            self.sdk.get(self.sdk.down(name))
        except Exception as error:
            if type(error).__name__ != "ClusterDoesNotExist":
                raise

    @_limited(REFRESH_LIMIT_S, "the catalogue of prices")
    def offers(self, resources: Mapping[str, Any]) -> Sale:
        """Return the catalogue's offers for `resources`, as they will be launched."""
        with as_answer():
            asked = self.sky.Resources.from_yaml_config(copy.deepcopy(dict(resources)))
        names = []
        if any(one.cloud is None for one in asked):
            names = self.sdk.get(self.sdk.enabled_clouds())
        return catalogue.sale(asked, [self.sky.CLOUD_REGISTRY.from_str(name) for name in names])

    @_limited(REFRESH_LIMIT_S, "the features of clouds")
    def lacking(self, resources: Mapping[str, Any]) -> Mapping[str, str]:
        """Return what each VM cloud lacks for `resources`."""
        found = {}
        for name in VM_CLOUDS:
            (asked,) = self.sky.Resources.from_yaml_config({**resources, "cloud": name})
            found[name] = catalogue.missing(self.sky.CLOUD_REGISTRY.from_str(name), asked)
        return found

    @_limited(CHECK_LIMIT_S, "the check of credentials")
    def check(self, clouds: Sequence[str]) -> Mapping[str, str]:
        """Test the credentials of clouds (all if empty): cloud -> "" or what is wrong."""
        told = io.StringIO()
        request = self.sdk.check(tuple(clouds) or None, verbose=False)
        enabled = self.sdk.stream_and_get(request, output_stream=told)
        usable = {
            cloud.lower()
            for workspace in enabled.values()
            for cloud, capabilities in workspace.items()
            if "compute" in capabilities
        }
        reasons = told_reasons(told.getvalue())
        asked = {cloud.lower() for cloud in clouds} or usable | set(reasons)
        return {
            cloud: "" if cloud in usable else reasons.get(cloud, "SkyPilot has no access to it")
            for cloud in sorted(asked)
        }

    @_limited(ASK_LIMIT_S, "the version of the API server")
    def renew_server(self) -> str:
        """Stop an idle local API server of another SkyPilot version; return a message, or ""."""
        try:
            found = str(getattr(self.sdk.api_info(), "version", None) or self.sky.__version__)
        except Exception as error:
            if type(error).__name__ in ("ApiServerConnectionError", "RuntimeError"):
                return ""  # no server: a new one will have this version
            raise
        if found == self.sky.__version__:
            return ""
        both = f"SkyPilot's API server is {found}, but {self.sky.__version__} is installed here"
        if not importlib.import_module("sky.server.common").is_api_server_local():
            return both
        own = importlib.import_module("sky.skylet.constants").SKYPILOT_SYSTEM_USER_ID
        asked = [one for one in self.sdk.api_status() if own not in (one.user_id, one.user_name)]
        if any(request_of(one).active for one in asked):  # its internal requests never end
            return f"{both}: it is busy; run `sky api stop` once it is idle"
        self.sdk.api_stop()
        return f"{both}: it was idle and has been restarted"

    @_limited(REFRESH_LIMIT_S, "the credentials that a VM would get")
    def uploaded_credentials(self, clouds: Sequence[str]) -> Sequence[str] | None:
        """Return the credential files that a VM gets anyway; None: a remote API server decides."""
        return self._settings.uploaded(clouds)

    def _log(self, lines: int, read: Callable[..., object]) -> str:
        self.load()
        out = io.StringIO()
        with contextlib.suppress(CloudError):  # a log that is missing must not hide the failure
            tail = functools.partial(read, follow=False, tail=lines, output_stream=out)
            self.within(JOB_LIMIT_S, f"log {id(out)}", tail)
        return out.getvalue()

    def load(self) -> None:
        """Import SkyPilot. Raises CloudError: it cannot be used here."""
        with self._lock:
            if self.sdk is not None:
                return
            os.environ.setdefault(NO_REPORTS, "1")  # unless the user has set it
            logging.basicConfig(handlers=[logging.NullHandler()])  # else SkyPilot sets one up
            try:
                self.sky = importlib.import_module("sky")
                self.sdk = importlib.import_module("sky.client.sdk")
            except ImportError as error:
                raise CloudError(
                    f"SkyPilot cannot be used here: {error}",
                    "`pip install 'fogft[cloud]'`, or run with `--cloud local`",
                ) from error

    def _asked(self, **filters: Any) -> list[Any]:
        """Return API requests. Without the first call, a dead local server looks like "none"."""
        try:
            self.sdk.api_info()  # also tells the client which filters this server knows
        except Exception:
            # Starts a local server; raises what is wrong with a remote one.
            self.sdk.status(["fogft-is-the-server-there"])
        return list(self.sdk.api_status(**filters))
