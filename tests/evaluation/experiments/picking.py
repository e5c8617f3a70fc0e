"""Experiment `picking`: scan, pick and place while both servers are lost in turn (section IV.D).

The story is one run: (A) two servers, (B) the first is ended, (C) it has been replaced, (D) the
second is ended, (E) it has been replaced. A trial is a request of the arm's, in their order.

Owns: the story and whose answer won. Not here: the arm, its camera and its checks, which are the
ordinary nodes of `templates/pick`; pictures (`picking_figures`).
"""

from __future__ import annotations

import contextlib
import csv
import ctypes.util
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.estimates import mean, median, p99
from tests.evaluation import comparing, workspaces
from tests.evaluation.errors import EvaluationError
from tests.evaluation.experiment import Defaults, Finding, Row, Run, Scale, Stage, Table
from tests.evaluation.experiments import picking_figures
from tests.evaluation.pools import Pools
from tests.evaluation.samples import Samples

TYPE = "pick_interfaces/srv/LocateTag"
SERVICE = "/locate_tag"
POOL = "pick"
ALL = "timeline"
TIMEOUT_S = 5.0
PERIOD_S = 0.2
PACE = 2.0
DELAYS_MS = {"us-west-1": 8.0, "us-west-2": 10.0}  # each way, about what the distances give
PHASES = {
    "A": "two servers",
    "B": "#1 ended",
    "C": "#1 recovered",
    "D": "#2 ended",
    "E": "#2 recovered",
}
BOOT_S = 5.0
WAIT_S = 300.0


class Picking(Defaults):
    """See docs/design/evaluation.md."""

    name = "picking"
    title = "Scan, pick and place while servers are lost and come back"
    claim = (
        "A UR10e with a wrist camera moves a tagged box to and fro for hours; an AprilTag service "
        "on two spot VMs tells where it is. One VM is terminated by hand, then, after it has come "
        "back, the other. The robot works on, with answers of the server that is left."
    )
    method = (
        "A simulated arm with a UR10e's link lengths (MuJoCo), its camera's images of 640 x 480 "
        "sent to an AprilTag service as an ordinary ROS 2 node on two replicas: a request for "
        f"each scan, on which the cycle depends, and one each {PERIOD_S:g} s while the arm moves, "
        f"{PACE:g} times faster than in reality. Machines are killed with `fogft chaos kill` and "
        f"take {BOOT_S:g} s to boot in place of a cloud's minutes. Paths have delays of 8 and "
        "10 ms each way. `winner` is the slot that answered first, by the proxy's own trace; "
        "`passed` counts the requests since the row before, of which `passed_failed` failed: more "
        "than one only while the story waits for a machine."
    )
    fields = (
        *("ok", "latency_s", "at_s", "phase", "winner", "cycle", "scan", "found", "error_m"),
        *("passed", "passed_failed", "cycles", "failed_cycles", "state"),
    )
    measures = ("latency_s",)

    def __init__(self) -> None:
        super().__init__(
            modules={"mujoco": "vision", "pupil_apriltags": "vision", "PIL": "vision"}, whole=True
        )

    def trials(self, scale: Scale) -> Mapping[str, int]:
        """Requests: some 50 seconds, 4 minutes, 20 minutes."""
        return {ALL: scale.choose(quick=200, normal=1000, full=5000)}

    @contextlib.contextmanager
    def session(self, stage: Stage) -> Iterator[Run]:
        """Start the pool and the arm."""
        if "MUJOCO_GL" not in os.environ and not ctypes.util.find_library("EGL"):
            raise EvaluationError(
                "the arm's camera needs EGL to draw (Debian: apt install libegl1 libgl1-mesa-dri)"
            )
        workspace = workspaces.ready("pick")
        workspaces.adopt(workspace, TYPE)
        count = self.trials(stage.scale)[ALL]
        with stage.pools() as pools:
            pools.regions(f"boot_s: {BOOT_S:g}\nregions: {{us-west-1: {{}}, us-west-2: {{}}}}\n")
            pools.up(_pool_file(pools, workspace))
            for slot, region in _slots(pools).items():
                _slow(pools, slot, region)
            with _Arm(pools, workspace) as arm:
                story = Story(pools, arm, count)
                yield lambda _, number: story.row(number)

    def findings(self, samples: Samples) -> Sequence[Finding]:
        """Say what failed, and how each phase went."""
        rows = samples[ALL]
        asked = sum(int(row["passed"]) for row in rows)
        failed = sum(int(row["passed_failed"]) for row in rows)
        last = rows[-1]
        found = [
            Finding(
                f"cycles failed, of {last['cycles']}", "0", f"{last['failed_cycles']}", "",
                "" if not last["failed_cycles"] else "See the rows that are not ok.",
            ),
            Finding(
                f"requests failed, of {asked}", "-", f"{failed}", "",
                "The paper's figure shows no gap and counts none.",
            ),
        ]  # fmt: skip
        for phase, word in PHASES.items():
            winners = {str(row["winner"]) for row in rows if row["phase"] == phase} - {""}
            named = " and ".join(f"#{int(slot) + 1}" for slot in sorted(winners))
            paper = {"B": "#2", "D": "#1"}.get(phase, "#1 and #2")
            why = "" if named == paper else "One replica was faster in every request."
            found.append(Finding(f"({phase}) {word}: who answered", paper, named or "-", "", why))
        return found

    def tables(self, samples: Samples) -> Sequence[Table]:
        """Return a line for each phase."""
        lines = []
        for phase, word in PHASES.items():
            rows = [row for row in samples[ALL] if row["phase"] == phase]
            if not rows:
                continue
            took = [float(row["latency_s"]) for row in rows]
            won = [sum(str(row["winner"]) == str(slot) for row in rows) for slot in (0, 1)]
            spent = float(rows[-1]["at_s"]) - float(rows[0]["at_s"])
            numbers = [mean(took), median(took), p99(took), max(took)]
            lines.append(
                [f"{phase}: {word}", f"{spent:.0f}", str(len(rows)), *map(str, won)]
                + [f"{1000 * number:.1f}" for number in numbers]
            )
        head = ["phase", "s", "requests", "#1 first", "#2 first"]
        head += ["mean, ms", "p50, ms", "p99, ms", "longest, ms"]
        return [Table("The timeline, phase by phase", head, lines)]

    def figures(self, samples: Samples) -> Mapping[str, Any]:
        """Draw the timeline, and the arm at moments of it."""
        return picking_figures.draw(samples[ALL], PHASES)


# -- the pool ------------------------------------------------------------------------------------


def _pool_file(pools: Pools, workspace: Path) -> Path:
    run = shlex.join([sys.executable, "tag_service.py", "--service", SERVICE])
    advanced = "advanced: {trace: true}"
    entry = f"{{name: {SERVICE}, type: {TYPE}, timeout_s: {TIMEOUT_S:g}, {advanced}}}"
    return comparing.pool_file(pools, POOL, 2, workspace, run, entry)


def _slots(pools: Pools) -> dict[int, str]:
    """Return the region of each ready slot."""
    return {r["slot"]: r["location"].split("/")[1] for r in pools.ready(POOL)}


def _slow(pools: Pools, slot: int, region: str) -> None:
    """Give a machine's path its distance; a new machine has none yet."""
    pools.fogft("chaos", "slow", str(slot), f"{DELAYS_MS.get(region, 0):g}", "--pool", POOL)


# -- the arm -------------------------------------------------------------------------------------


class _Arm:
    """The client's process, and what it and the proxy have written so far."""

    def __init__(self, pools: Pools, workspace: Path) -> None:
        self._samples = pools.folder / "samples.csv"
        self._trace = pools.home / "pools" / POOL / "trace.jsonl"
        self._log = (pools.folder / "pick_client.log").open("w+")
        self._process = subprocess.Popen(
            [
                *(sys.executable, "pick_client.py", "--samples", str(self._samples)),
                *("--pace", f"{PACE:g}", "--period-s", f"{PERIOD_S:g}"),
                *("--timeout-s", f"{2 * TIMEOUT_S:g}", "--wait-s", "120"),
            ],
            cwd=workspace, env=pools.environ, stdout=subprocess.PIPE, stderr=self._log, text=True,
            start_new_session=True,
        )  # fmt: skip
        self.summary: dict[str, Any] = {}

    def __enter__(self) -> _Arm:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
        self._log.close()

    def finish(self) -> None:
        """Let it end its cycle; afterwards `summary` says what it counted."""
        self._process.send_signal(signal.SIGINT)
        out, _ = self._process.communicate(timeout=WAIT_S)
        self.summary = json.loads(out)

    def rows(self) -> list[dict[str, str]]:
        """Return the requests that have ended and whose winner is known, in their order."""
        if self._process.poll() not in (None, 0, 1):
            self._log.seek(0)
            raise EvaluationError(f"the arm's program ended:\n{self._log.read()[-2000:]}")
        try:
            whole, _, _ = self._samples.read_text().rpartition("\n")
            trace, _, _ = self._trace.read_text().rpartition("\n")
        except FileNotFoundError:
            return []
        # One request at a time: the proxy's lines are in the order of the arm's.
        winners = [json.loads(line)["replica"] for line in trace.splitlines()]
        found = csv.DictReader(whole.splitlines())
        return [{**r, "winner": w} for r, w in zip(found, winners, strict=False)]


# -- the story -----------------------------------------------------------------------------------


@dataclass
class Story:
    """Takes the arm's requests in their order, and ends machines when it is time.

    Args:
        pools: The pool.
        arm: Who asks.
        count: How many rows there shall be.
    """

    pools: Pools
    arm: _Arm
    count: int

    def __post_init__(self) -> None:
        self._taken = 0
        self._began = 0.0  # of the first request, seconds since the epoch
        self._before: dict[int, int] = {}  # slot -> generation, when a machine was ended
        self._ended: dict[int, float] = {}  # slot -> when
        self._whole: dict[int, float] = {}  # slot -> when it had been replaced
        self._again: set[int] = set()  # slots whose new machine has been given its distance

    def row(self, number: int) -> Row:
        """Return the next request; those that passed while a machine is waited for are counted."""
        part = number / self.count
        if part >= 0.2:
            self._end(0)
        if part >= 0.55:
            self._recovered(0, wait=True)
            self._end(1)
        if part >= 0.9:
            self._recovered(1, wait=True)
        for slot in self._ended:
            self._recovered(slot, wait=False)
        if number == self.count - 1:
            self.arm.finish()
        self.pools.wait(
            lambda: len(self.arm.rows()) > self._taken, "the arm's next request", WAIT_S
        )
        rows = self.arm.rows()
        # Behind the story only as far as it waited: then it catches up at once.
        late = number in self._catching_up() or number == self.count - 1
        passed = rows[self._taken :] if late else rows[self._taken : self._taken + 1]
        self._taken += len(passed)
        return self._as_row(passed)

    def _catching_up(self) -> tuple[int, ...]:
        return tuple(-(-self.count * part // 100) for part in (55, 90))

    def _as_row(self, passed: Sequence[Mapping[str, str]]) -> Row:
        last = passed[-1]
        began_at = float(last["began_at"])
        self._began = self._began or began_at
        answered = last["answered"] == "1"
        self._note_winner(last["winner"], began_at)
        error_m = float(last["error_m"]) if last["error_m"] else ""
        return {
            "ok": answered and (error_m == "" or error_m <= 0.01),
            "latency_s": float(last["latency_s"]),
            "at_s": round(began_at - self._began, 3),
            "phase": self._phase(began_at),
            "winner": last["winner"].split(".")[0],
            "cycle": int(last["cycle"]),
            "scan": int(last["scan"]),
            "found": int(last["found"]),
            "error_m": error_m,
            "passed": len(passed),
            "passed_failed": sum(each["answered"] != "1" for each in passed),
            "cycles": self.arm.summary.get("cycles", int(last["cycle"])),
            "failed_cycles": self.arm.summary.get("failed_cycles", 0),
            "state": last["state"],
        }

    def _note_winner(self, winner: str, began_at: float) -> None:
        """Take a new machine's first answer for its return, where that comes before the status."""
        if not winner:
            return
        slot, generation = map(int, winner.split("."))
        if slot in self._ended and generation > self._before[slot]:
            self._whole[slot] = min(began_at, self._whole.get(slot, began_at))

    def _phase(self, at: float) -> str:
        moments = (self._ended.get(0), self._whole.get(0), self._ended.get(1), self._whole.get(1))
        return "ABCDE"[sum(moment is not None and at >= moment for moment in moments)]

    def _end(self, slot: int) -> None:
        """Kill a slot's machine, once."""
        if slot in self._ended:
            return
        self.pools.wait_whole(POOL)
        self._before |= {r["slot"]: r["generation"] for r in self.pools.ready(POOL)}
        self.pools.fogft("chaos", "kill", str(slot), "--pool", POOL)
        self._ended[slot] = time.time()  # it is gone: the command waits for that

    def _recovered(self, slot: int, *, wait: bool) -> None:
        """Note when a slot is ready again; give the new machine's path its distance."""
        if slot in self._again:
            return
        old = self._before[slot]

        def new() -> list[Mapping[str, Any]]:
            ready = self.pools.ready(POOL)
            return [r for r in ready if r["slot"] == slot and r["generation"] > old]

        if wait:
            self.pools.wait(new, f"the replacement of slot {slot}", WAIT_S)
        elif not new():
            return
        self._whole.setdefault(slot, time.time())
        self._again.add(slot)
        _slow(self.pools, slot, _slots(self.pools)[slot])


EXPERIMENT = Picking()
