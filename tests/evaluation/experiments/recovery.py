"""Experiment `recovery`: how long until a lost replica is noticed and replaced.

Owns: faults and moments. Not here: the service, which is `templates/echo`, and the faults
themselves (`fogft chaos`).
"""

from __future__ import annotations

import contextlib
import shlex
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from tests.estimates import estimate, median
from tests.evaluation import plotting
from tests.evaluation.caller import Caller
from tests.evaluation.errors import EvaluationError
from tests.evaluation.experiment import Defaults, Finding, Row, Run, Scale, Stage
from tests.evaluation.pools import Pools
from tests.evaluation.samples import Samples

POOL, SERVICE = "echo", "/echo"
PERIOD_S = 0.05  # from request to request
LIMIT_S = 10.0
WAIT_S = 180.0
MOMENTS = ("noticed_s", "ordered_s", "whole_s")


class Recovery(Defaults):
    """See docs/design/evaluation.md."""

    name = "recovery"
    title = "Not in the paper: time to notice and to replace"
    claim = (
        "The paper names up to 20 minutes from preemption to a new server, most of it set-up, and "
        "gives neither the time to notice nor the requests that were lost meanwhile."
    )
    method = (
        "A pool of two replicas on the local cloud, asked 20 times a second by an ordinary "
        "client; one replica's machine is killed (SIGKILL) or frozen (SIGSTOP), and the next "
        "trial waits until the pool is whole. 'Noticed': the pool's status no longer shows it in "
        "good health; 'ordered': its replacement is launched; 'whole': that one answers. A "
        "machine boots in half a second here; on a cloud its minutes are added to 'whole' and to "
        "nothing else. "
        "A frozen replica is replaced after 15 s of silence, the default of `replace_after_s`."
    )
    fields = ("fault", *MOMENTS, "asked", "failed", "longest_gap_s")

    def __init__(self) -> None:
        super().__init__(measures=(*MOMENTS, "longest_gap_s"))

    def trials(self, scale: Scale) -> Mapping[str, int]:
        """A trial is a fault."""
        return {
            "kill": scale.choose(quick=2, normal=10, full=30),
            "freeze": scale.choose(quick=1, normal=5, full=15),
        }

    @contextlib.contextmanager
    def session(self, stage: Stage) -> Iterator[Run]:
        """Start the pool and ask without end."""
        with stage.pools() as pools:
            file = _pool_file(pools)
            pools.up(file)
            with Caller(pools.domain) as caller, _Asking(caller) as asking:
                yield lambda condition, number: _break(pools, asking, condition, number)

    def findings(self, samples: Samples) -> Sequence[Finding]:
        """Return medians and lost requests."""
        found = []
        words = {"noticed_s": "noticed", "ordered_s": "replacement ordered", "whole_s": "whole"}
        for condition in samples:
            for field, word in words.items():
                paper = "up to 1200" if field == "whole_s" else "-"
                why = (
                    "A process in place of a VM: the minutes of a boot are missing."
                    if field == "whole_s"
                    else ""
                )
                found.append(
                    Finding(
                        f"{condition}: {word} after, median",
                        paper,
                        estimate(samples.column(condition, field), median),
                        "s",
                        why,
                    )
                )
            failed, asked = (
                sum(map(int, samples.column(condition, f))) for f in ("failed", "asked")
            )
            found.append(Finding(f"{condition}: requests failed, of {asked}", "-", str(failed), ""))
        return found

    def figures(self, samples: Samples) -> Mapping[str, Any]:
        """Draw the moments of each trial."""
        figure, axes = plotting.figure(1, len(samples))
        for axis, condition in zip(axes[0], samples, strict=True):
            for colour, field in zip(plotting.COLOURS, MOMENTS, strict=False):
                values = samples.column(condition, field)
                plotting.distribution(axis, values, colour, field.removesuffix("_s"))
            axis.set_title(condition, fontsize=9)
            axis.set_xlabel("seconds after the fault", fontsize=8)
            axis.set_ylabel("fraction of trials", fontsize=8)
            axis.legend(fontsize=7)
        return {"moments": figure}


class _Asking:
    """Asks at a steady pace, each request on its own, until its block ends."""

    def __init__(self, caller: Caller) -> None:
        from std_srvs.srv import SetBool

        self._caller, self._type = caller, SetBool
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._answered_at: list[float] = []
        self._asked = self._failed = 0
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> _Asking:
        self._caller.wait(SERVICE, self._type)
        # So many may wait at once: enough for a second of silence.
        for number in range(20):
            thread = threading.Thread(target=self._work, args=(number,), daemon=True)
            self._threads.append(thread)
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join(timeout=2 * LIMIT_S)

    def _work(self, number: int) -> None:
        self._ended.wait(number * PERIOD_S)
        while not self._ended.is_set():
            asked = self._type.Request(data=True)
            response, took_s = self._caller.call(SERVICE, self._type, asked, LIMIT_S)
            with self._lock:
                self._asked += 1
                if response is not None and response.message == "heard True":
                    self._answered_at.append(time.perf_counter())
                else:
                    self._failed += 1
            self._ended.wait(max(0.0, 20 * PERIOD_S - took_s))

    def begin(self) -> None:
        """Count from now on."""
        with self._lock:
            self._asked = self._failed = 0
            self._answered_at = [time.perf_counter()]

    def counted(self) -> tuple[int, int, float]:
        """Return requests, failures, and the longest time between two answers."""
        with self._lock:
            moments = sorted([*self._answered_at, time.perf_counter()])
            gaps = [b - a for a, b in pairwise(moments)]
            return self._asked, self._failed, max(gaps)


def _pool_file(pools: Pools) -> Path:
    folder = pools.init("echo", POOL)
    (folder / "pool.yaml").write_text(
        f"name: {POOL}\n"
        "resources: {any_of: [{infra: local/us-west-1}, {infra: local/us-west-2}]}\n"
        "workdir: .\n"
        f"run: exec {shlex.quote(sys.executable)} echo_service.py\n"
        "fogft:\n"
        f"  services: [{{name: {SERVICE}, type: std_srvs/srv/SetBool, timeout_s: {LIMIT_S:g}}}]\n"
        "  replicas: 2\n"
    )
    return folder / "pool.yaml"


def _break(pools: Pools, asking: _Asking, fault: str, number: int) -> Row:
    """Bring one fault; wait until the pool is whole again; say how long everything took."""
    pools.wait(lambda: _settled(pools), "the pool to be whole, and nothing else left of it")
    slot = number % 2
    (before,) = (r["generation"] for r in pools.ready(POOL) if r["slot"] == slot)
    (pid,) = pools.service_pids(POOL, slot, "echo_service.py")
    asking.begin()
    moments: dict[str, float] = {}
    ended = threading.Event()
    watching = threading.Thread(
        target=_watch, args=(pools, slot, before, pid, moments, ended), daemon=True
    )
    watching.start()
    pools.fogft("chaos", fault, str(slot), "--pool", POOL)
    if not ended.wait(WAIT_S):
        ended.set()
        raise EvaluationError(f"the pool was not whole {WAIT_S:g} s after a {fault}: {moments}")
    watching.join()
    asked, failed, gap_s = asking.counted()
    since = moments.pop("fault")
    return {
        "fault": fault,
        **{f"{name}_s": moment - since for name, moment in moments.items()},
        "asked": asked,
        "failed": failed,
        "longest_gap_s": gap_s,
    }


def _settled(pools: Pools) -> bool:
    return len(pools.status(POOL)["replicas"]) == len(pools.ready(POOL)) == 2


def _watch(
    pools: Pools,
    slot: int,
    before: int,
    pid: int,
    moments: dict[str, float],
    ended: threading.Event,
) -> None:
    """Note when the service stopped and what became visible when; a look each 5 ms."""
    while not ended.wait(0.005 if "fault" in moments else 0.002):
        now = time.perf_counter()
        if "fault" not in moments:
            if _stopped(pid):
                moments["fault"] = now
            continue
        replicas = pools.status(POOL).get("replicas", ())
        old = [r for r in replicas if (r["slot"], r["generation"]) == (slot, before)]
        new = [r for r in replicas if r["slot"] == slot and r["generation"] > before]
        healthy = any((r["verdict"], r["link"]) == ("good", "up") for r in old)
        if not healthy:
            moments.setdefault("noticed", now)
        if new:
            moments.setdefault("ordered", now)
        if any(r["generation"] > before for r in pools.ready(POOL) if r["slot"] == slot):
            moments.setdefault("noticed", now)
            moments.setdefault("whole", now)
            ended.set()


def _stopped(pid: int) -> bool:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return True
    return stat.rpartition(") ")[2][0] in "TtZX"


EXPERIMENT = Recovery()
