"""Experiment `detection`: object detection with a slow network to one region (section IV.C).

Owns: four pools, their paths' delays, what a row says. Not here: the detector, which is the
ordinary node of `templates/detect`.
"""

from __future__ import annotations

import contextlib
import importlib.util
import random
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

from tests.estimates import median
from tests.evaluation import comparing, workspaces
from tests.evaluation.caller import Caller
from tests.evaluation.comparing import CONDITIONS, REGIONS, faulted, replicas
from tests.evaluation.errors import EvaluationError
from tests.evaluation.experiment import Defaults, Finding, Row, Run, Scale, Stage, Table
from tests.evaluation.pools import Pools
from tests.evaluation.samples import Samples

TYPE = "detect_interfaces/srv/Detect"
HEALTHY_S = 0.09  # what a request shall take without the fault
FAULT_S = 0.1  # added to the round trip to us-west-1
LEAST_DELAY_S = 0.01
TIMEOUT_S = 10.0
THRESHOLD = 0.4
LEAST_OVERLAP = 0.5


class Detection(Defaults):
    """See docs/design/evaluation.md."""

    name = "detection"
    title = "Object detection under a regional network slowdown"
    claim = (
        "YOLOv8 on one server in us-west-1 and on two replicas, in us-west-1 and us-west-2, 300 "
        "trials. With 100 ms more to all servers in us-west-1, two replicas are 2.1 times faster "
        "on average and 3.9 times in the P99; without, both are alike."
    )
    method = (
        "SSD-MobileNetV2 with its trained weights (Open Images V4) as an ordinary ROS 2 service, "
        "640 x 480 JPEG images drawn anew for each trial, and every answer checked: the drawn "
        "thing must be found where it was drawn. Four pools side by side, one for each condition. "
        "The same delay on all paths (`fogft chaos slow`) brings a request near 90 ms on an idle "
        "machine; with the fault the round trip to us-west-1 takes 100 ms more. `rtt_west_1_s` and "
        "`rtt_west_2_s` are what the robot's proxy measured on its links: the fault as it was seen."
    )
    fields = ("ok", "latency_s", "rtt_west_1_s", "rtt_west_2_s", "delay_s", "fault")
    measures = ("latency_s", "rtt_west_1_s", "rtt_west_2_s")

    def __init__(self) -> None:
        super().__init__(
            modules={"ai_edge_litert": "vision", "PIL": "vision"},
            options={
                "detector": "a folder with the detector's weights, where npm cannot load them"
            },
        )

    def trials(self, scale: Scale) -> Mapping[str, int]:
        """As many as the paper's, unless it is to be quick."""
        count = scale.choose(quick=50, normal=300, full=300)
        return dict.fromkeys(CONDITIONS, count)

    @contextlib.contextmanager
    def session(self, stage: Stage) -> Iterator[Run]:
        """Load the weights, start four pools, and slow their paths."""
        workspace = workspaces.ready("detect")
        weights = Path(stage.options.get("detector") or workspace / "weights")
        _fetch(workspace, weights)
        type = workspaces.adopt(workspace, TYPE)
        with stage.pools() as pools:
            files = [_pool_file(pools, workspace, weights, c) for c in CONDITIONS]
            pools.up(*files)
            with Caller(pools.domain) as caller:
                trial = _Trial(pools, caller, type, workspace)
                trial.slow_down()
                yield trial.run

    def findings(self, samples: Samples) -> Sequence[Finding]:
        """Compare the four ratios, and how far the fault reached."""
        paper = {"": ("similar", "similar"), "-fault": ("2.1", "3.9")}
        return [*comparing.findings(samples, paper, _whys(samples)), *_reached(samples)]

    def tables(self, samples: Samples) -> Sequence[Table]:
        """Return what failed."""
        return [comparing.requests(samples)]

    def figures(self, samples: Samples) -> Mapping[str, Any]:
        """Draw as the paper does."""
        return {"latency": comparing.figure(samples, self.title)}


def _whys(samples: Samples) -> Mapping[str, str]:
    middle = comparing.medians(samples, "latency_s", CONDITIONS)
    healthy = 1000 * middle["two-fault"]
    shared = (
        "Both replicas compute every request on this machine's shared cores, so two answer a "
        "little later than one"
    )
    mean_less = (
        f"The fault adds 100 ms to a request that otherwise takes {healthy:.0f} ms in the median "
        f"here, so the ratio can at most be {1 + 100 / healthy:.2g}. {shared}."
    )
    return {
        "mean healthy": f"As in the paper where it is near 1. {shared}.",
        "P99 healthy": "A P99 is made of this machine's own pauses, which hit all its replicas.",
        "mean less": mean_less,
        "mean more": "The machine's load fell on the one server more than on the two.",
        "P99 less": (
            "A constant delay shifts one server's whole distribution by 100 ms and its P99 with "
            "it: it cannot give 3.9 unless a path also loses packets or queues, which the paper "
            "does not say. And the tail of two replicas is this machine's own, which both share."
        ),
        "P99 more": "The machine's own pauses fell on the one server more than on the two.",
    }


def _reached(samples: Samples) -> Iterator[Finding]:
    for condition in ("single-fault", "two-fault"):
        middle = median(samples.column(condition, "rtt_west_1_s"))
        other = median(samples.column("single", "rtt_west_1_s"))
        yield Finding(
            f"{comparing.LABELS[condition]}: round trip to us-west-1 over that without the fault",
            "100",
            f"{1000 * (middle - other):.0f}",
            "ms",
            "Medians of what the proxy's probes measured; they have no part in the requests.",
        )


# -- one session ---------------------------------------------------------------------------------


def _fetch(workspace: Path, weights: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(workspace / "fetch_weights.py"), str(weights)],
        capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    if done.returncode:
        raise EvaluationError(
            f"{done.stderr.strip()}\nhint: `--detector DIR` takes them from a folder"
        )


def _pool(condition: str) -> str:
    return f"detect-{condition}"


def _service(condition: str) -> str:
    return f"/detect_{condition.replace('-', '_')}"


def _pool_file(pools: Pools, workspace: Path, weights: Path, condition: str) -> Path:
    service = _service(condition)
    words = [sys.executable, "detect_service.py", "--service", service, "--weights", str(weights)]
    entry = f"{{name: {service}, type: {TYPE}, timeout_s: {TIMEOUT_S:g}}}"
    count = replicas(condition)
    return comparing.pool_file(pools, _pool(condition), count, workspace, shlex.join(words), entry)


def _module(workspace: Path, name: str) -> ModuleType:
    """Import a module of the example under a name of its own."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", workspace / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


class _Trial:
    """Asks what is in a picture and says what became of it."""

    def __init__(self, pools: Pools, caller: Caller, type: Any, workspace: Path) -> None:
        self._pools, self._caller, self._type = pools, caller, type
        self._pictures, self._ssd = (_module(workspace, name) for name in ("pictures", "ssd"))
        self._delay_s = 0.0
        self._slowed: dict[tuple[str, str], int] = {}  # path -> generation of its machine

    def slow_down(self) -> None:
        """Bring healthy requests near `HEALTHY_S`, and the fault where it belongs."""
        for condition in CONDITIONS:
            self._caller.wait(_service(condition), self._type)
            self._ask(condition, 0)  # the first one takes longer
        quick = median([self._ask("two", number)[1] for number in range(15)])
        self._delay_s = max(LEAST_DELAY_S, (HEALTHY_S - quick) / 2)
        paths = [(c, r) for c in CONDITIONS for r in REGIONS[: replicas(c)]]
        with ThreadPoolExecutor(2) as threads:
            list(threads.map(lambda path: self._slow(*path), paths))

    def _expected_s(self, condition: str, region: str) -> float:
        """Return what the path shall add to a round trip."""
        fault_s = FAULT_S if faulted(condition) and region == REGIONS[0] else 0.0
        return 2 * self._delay_s + fault_s

    def _slow(self, condition: str, region: str) -> None:
        """Slow a path, and wait until the proxy's probes have seen it."""
        pool, trip_s = _pool(condition), self._expected_s(condition, region)
        found = comparing.replica_in(self._pools, pool, region)
        way = f"{1000 * trip_s / 2:.3f}"
        self._pools.fogft("chaos", "slow", str(found["slot"]), way, "--pool", pool)
        self._slowed[condition, region] = found["generation"]
        self._pools.wait(
            lambda: self._rtt_s(condition, region) >= trip_s,
            f"the slow path of {condition} to {region}",
        )

    def _keep_slow(self, condition: str) -> None:
        """Slow the path to a machine that has replaced another; on a busy computer that happens."""
        self._pools.wait_whole(_pool(condition))
        for region in REGIONS[: replicas(condition)]:
            found = comparing.replica_in(self._pools, _pool(condition), region)
            if found["generation"] != self._slowed[condition, region]:
                self._slow(condition, region)

    def run(self, condition: str, number: int) -> Row:
        """Ask once."""
        self._keep_slow(condition)
        answer, took_s, drawn = self._ask(condition, number)
        fault = "no answer" if answer is None else self._wrong(drawn, answer)
        west = [self._rtt_s(condition, region) for region in REGIONS[: replicas(condition)]]
        return {
            "ok": not fault,
            "latency_s": took_s,
            "rtt_west_1_s": west[0] or "",
            "rtt_west_2_s": (west[1] or "") if len(west) > 1 else "",
            "delay_s": self._delay_s,
            "fault": fault,
        }

    def _rtt_s(self, condition: str, region: str) -> float:
        """Return what the proxy's probes measured last; 0 while there is nothing."""
        replicas = self._pools.status(_pool(condition)).get("replicas", ())
        return next((r["rtt_s"] or 0.0 for r in replicas if region in r["location"]), 0.0)

    def _ask(self, condition: str, number: int) -> tuple[Any, float, Any]:
        """All conditions are asked about the same picture in the same trial."""
        drawn = self._pictures.picture(random.Random(number))
        asked = self._type.Request(threshold=THRESHOLD)
        asked.image.format = "jpeg"
        asked.image.data = drawn.jpeg()
        return (*self._caller.call(_service(condition), self._type, asked, TIMEOUT_S), drawn)

    def _wrong(self, drawn: Any, answer: Any) -> str:
        if not answer.labels or answer.labels[0] != drawn.label:
            return f"{', '.join(answer.labels[:1]) or 'nothing'} for {drawn.label}"
        shared = self._ssd.overlap(drawn.box, tuple(answer.boxes[:4]))
        return "" if shared >= LEAST_OVERLAP else f"{drawn.label} elsewhere"


EXPERIMENT = Detection()
