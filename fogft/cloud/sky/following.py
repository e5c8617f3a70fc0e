"""Follow a launch from the order to the running job, one level-triggered step at a time.

A step can be lost, repeated, or taken by another process after a crash. A launch that fails or
hangs is taken down at once, because a machine that it has created costs money. Time limits count
from when this process first saw the launch.
"""

import contextlib
import logging
from collections.abc import Callable
from dataclasses import dataclass, field

from fogft.cloud.sky.ending import Ending
from fogft.cloud.sky.failures import tail, told_last
from fogft.cloud.sky.installed import InstalledSky
from fogft.cloud.sky.journal import UNDER_WAY, Entry, Journal, Stage
from fogft.cloud.sky.naming import MAPPING_CLOUDS, cluster_name
from fogft.cloud.sky.sdk import ClusterState, JobState, RefusedError
from fogft.errors import CloudError, StateError
from fogft.model.names import SETUP_LIMIT_S
from fogft.model.reason import Cause, Reason
from fogft.model.replica import ReplicaId
from fogft.reason_words import words as in_words

log = logging.getLogger(__name__)

JOB_PAUSE_S = 20.0
"""Shortest pause before and between questions about a job. For each SkyPilot takes some ten seconds
of processor time, in one of its few workers; the pause grows with the time that an answer takes."""
_JOB_PAUSE_LIMIT_S = 300.0

_TRIES_LINES = 400  # of a launch's log: enough for its last attempts
ASK_LIMIT_S = 180.0
"""How long SkyPilot may take to accept a launch; after that, it never will."""
LAUNCH_LIMIT_S = 900.0
"""From SkyPilot's start to the running VM; `SETUP_LIMIT_S`: from the launch to the job."""


@dataclass
class Following:
    """Advances launches step by step; calls `on_move` when a launch reaches a new stage."""

    sky: InstalledSky
    journal: Journal
    ending: Ending
    clock: Callable[[], float]
    steady: Callable[[], float]  # monotonic seconds
    on_move: Callable[[], None]
    # Per launch: when this process first saw it reach a point, and may next query its job.
    _times: dict[ReplicaId, dict[str, float]] = field(default_factory=dict, init=False)

    def step(self, id: ReplicaId) -> bool:
        """Advance a launch; return whether it needs more. CloudUnreachable: nothing was learned."""
        steps = {
            Stage.ASKING: self._asking,
            Stage.LAUNCHING: self._launching,
            Stage.SETTING_UP: self._setting_up,
        }
        entry = self.journal.get(id)
        if entry is not None and (step := steps.get(entry.stage)) is not None:
            self._times.setdefault(id, {}).setdefault("ordered", self.steady())
            step(entry)
            entry = self.journal.get(id)
        if entry is not None and entry.stage in UNDER_WAY:
            return True
        self._times.pop(id, None)
        return False

    def _asking(self, entry: Entry) -> None:
        found = self.sky.launches(cluster_name(entry.id))
        requests = [one for one in found if one.active or not entry.starts]
        if found and not requests and self._lasts_s(entry) <= ASK_LIMIT_S:  # it may be up
            clusters = self.sky.clusters(cluster_name(entry.id), refresh=True)
            requests = [*found] if any(c.state is ClusterState.UP for c in clusters) else []
        if requests:
            self._move(entry, stage=Stage.LAUNCHING, request=requests[-1].id)
        elif self._lasts_s(entry) > ASK_LIMIT_S:
            self._fail(entry, Reason(Cause.ERROR, words="SkyPilot has no record of this launch"))

    def _launching(self, entry: Entry) -> None:
        request = self.sky.request(entry.request)
        if request is None:
            self._lost(entry)
        elif request.queued:  # behind others: the launch limit does not run yet
            if self._lasts_s(entry) > SETUP_LIMIT_S:
                self._fail(entry, self._hung(entry, SETUP_LIMIT_S, "queued"))
        elif request.active:
            if self._lasts_s(entry, "begun") > LAUNCH_LIMIT_S:
                self._fail(entry, self._hung(entry, LAUNCH_LIMIT_S, "launching"))
            elif not entry.placement.spot and not entry.endpoint:
                # Once the provider lists it: make it terminate, not stop, if it shuts down.
                for instance in self.ending.census.of(entry.id, entry) or ():
                    self.ending.census.end_when_shut_down(instance)
                    if instance.public_ip:
                        self._move(entry, endpoint=f"{instance.public_ip}:{entry.port}")
        else:
            try:
                job = self.sky.launched_job(entry.request)
            except RefusedError as error:
                self._fail(entry, self._refused(entry, error))
            else:
                self._move(entry, stage=Stage.SETTING_UP, job=job, running_at=self.clock())
                self._find_endpoint(entry)
                self.ending.census.of(entry.id, entry)  # once seen, its absence counts

    def _find_endpoint(self, entry: Entry) -> None:
        """Look up the endpoint of a machine whose cloud maps ports, until it is known."""
        if entry.endpoint or not entry.port or entry.placement.cloud not in MAPPING_CLOUDS:
            return
        try:
            found = self.sky.endpoint(cluster_name(entry.id), entry.port)
        except RefusedError as error:  # it is not mapped yet
            log.info("endpoint_unknown replica=%s reason=%r", entry.id.short, str(error))
        else:
            self._move(entry, endpoint=found)

    def _lost(self, entry: Entry) -> None:
        """Handle a request that SkyPilot lost (with its database, or with a replaced server)."""
        clusters = self.sky.clusters(cluster_name(entry.id), refresh=True)
        if any(c.state is ClusterState.UP for c in clusters):
            self._move(entry, stage=Stage.SETTING_UP, running_at=self.clock())
        else:
            self._fail(entry, Reason(Cause.ERROR, words="SkyPilot lost this launch"))

    def _setting_up(self, entry: Entry) -> None:
        asked_at = self.steady()
        times = self._times[entry.id]
        if asked_at < times.setdefault("job", asked_at + JOB_PAUSE_S):
            return
        self._find_endpoint(entry)
        try:
            job = self.sky.job(cluster_name(entry.id), entry.job)
        except RefusedError as error:  # the cluster is gone or not up: its list will show it
            log.info("job_unknown replica=%s reason=%r", entry.id.short, str(error))
            job = JobState.PENDING
        finally:
            now = self.steady()
            pause_s = max(JOB_PAUSE_S, 3 * (now - asked_at))
            times["job"] = now + min(pause_s, _JOB_PAUSE_LIMIT_S)
        if job is JobState.RUNNING:
            self._move(entry, stage=Stage.RUNNING, set_up_at=self.clock())
        elif job is JobState.SETUP_FAILED:
            self._fail(entry, Reason(Cause.SETUP, words="`setup` failed" + self._job_tail(entry)))
        elif job is JobState.MISSING:
            self._fail(entry, Reason(Cause.ERROR, words="SkyPilot started no job on the machine"))
        elif job is JobState.ENDED:
            words = "`fogft serve` exited on the machine" + self._job_tail(entry)
            self._fail(entry, Reason(Cause.ERROR, words=words))
        elif self._lasts_s(entry) > SETUP_LIMIT_S:  # only after an answer: silence proves nothing
            self._fail(entry, self._hung(entry, SETUP_LIMIT_S, "setting up"))

    def _fail(self, entry: Entry, failure: Reason) -> None:
        """Record the failure first, so that it is kept whatever happens during the teardown."""
        log.warning("launch_failed replica=%s reason=%r", entry.id.short, in_words(failure))
        with contextlib.suppress(StateError):  # a full disk is no reason to keep paying
            self.journal.update(entry.id, stage=Stage.FAILED, failure=failure)
        try:
            self.ending.end(entry.id)
            if self.journal.get(entry.id) == entry:  # not recorded: do not end it again and again
                self.journal.close(entry.id)
        except CloudError as error:  # it stays listed as failed until `terminate` succeeds
            log.warning("end_failed replica=%s reason=%r", entry.id.short, str(error))

    def _refused(self, entry: Entry, error: RefusedError) -> Reason:
        failure = error.reason
        if error.kind in ("CommandError", "ClusterSetUpError") and failure.cause is Cause.ERROR:
            log_tail = self._job_tail(entry)
            cause = Cause.SETUP if "setup" in " ".join(error.texts).lower() else Cause.ERROR
            return Reason(cause, words=failure.words + log_tail)
        if error.kind == "RequestCancelled":
            return Reason(Cause.ERROR, words="the launch was cancelled")
        if error.kind == "ResourcesUnavailableError" or failure.cause is Cause.ERROR:
            log = self.sky.provision_log(cluster_name(entry.id), _TRIES_LINES)
            return told_last(log) or failure
        return failure

    def _hung(self, entry: Entry, limit_s: float, doing: str) -> Reason:
        words = f"still {doing} after {limit_s:.0f} s"
        if entry.stage is not Stage.SETTING_UP:
            return Reason(Cause.TIMEOUT, words=words + self._provision_tail(entry))
        log_tail = self._job_tail(entry) or self._provision_tail(entry)
        awaited = Reason(Cause.NOT_SET_UP, seconds=limit_s)
        return Reason(Cause.TIMEOUT, words=words + log_tail, because=(awaited,))

    def _job_tail(self, entry: Entry) -> str:
        return tail(self.sky.job_log(cluster_name(entry.id), entry.job, 30))

    def _provision_tail(self, entry: Entry) -> str:
        return tail(self.sky.provision_log(cluster_name(entry.id), 30))

    def _move(self, entry: Entry, **changes: object) -> None:
        moved = self.journal.update(entry.id, **changes)
        if moved is not None and moved.stage is not entry.stage:
            log.info("launch_moved replica=%s stage=%s", entry.id.short, moved.stage.value)
            self.on_move()

    def _lasts_s(self, entry: Entry, since: str = "ordered") -> float:
        """Return how long this process has seen a launch, unaffected by clock changes."""
        return self.steady() - self._times[entry.id].setdefault(since, self.steady())
