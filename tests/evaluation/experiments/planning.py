"""Experiment `planning`: motion planning on one server and on replicas (the paper's section IV.B).

Owns: the pools, what is contended when, what a row says. Not here: the planner, which is the
ordinary node of `templates/motion`, and the pictures (`planning_figures`).
"""

from __future__ import annotations

import contextlib
import json
import random
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.bench.rig import ROOT
from tests.estimates import Estimate, mean, p99, ratio
from tests.evaluation.caller import Caller
from tests.evaluation.errors import EvaluationError
from tests.evaluation.experiment import Defaults, Finding, Row, Run, Scale, Stage, Table
from tests.evaluation.experiments import planning_figures
from tests.evaluation.pools import Pools
from tests.evaluation.samples import Samples
from tests.evaluation.steal import steal

TEMPLATE = ROOT / "templates" / "motion"
SCENES = ("cubicles", "home", "twist")
REPLICAS = (1, 2, 3)
REGIONS = ("us-west-1", "us-west-2", "us-east-1")
TIMEOUT_S = 100.0  # the paper's
RECORD = "searches.jsonl"
CONTENDED_SHARE = 0.02  # of a replica's requests
CONTENDED_FACTOR = 20.0
PAPERS_NAMES = {"cubicles": "Cubicles", "home": "Home", "twist": "TwistyCool"}


@dataclass(frozen=True)
class Condition:
    """One scene, so many replicas, with contention or without."""

    scene: str
    replicas: int
    contended: bool

    @property
    def name(self) -> str:
        """As its file is called."""
        how = "contended" if self.contended else "clean"
        return f"{self.scene}-{how}-{self.replicas}"

    @classmethod
    def of(cls, name: str) -> Condition:
        """Read a name."""
        scene, how, replicas = name.split("-")
        return cls(scene, int(replicas), how == "contended")


def contended_trials(condition: Condition, slot: int, trials: int) -> frozenset[int]:
    """Return the trials in which a replica is contended: 2 in 100, at least one, by chance.

    Replicas are drawn independently of one another.
    """
    if not condition.contended:
        return frozenset()
    source = random.Random(f"{condition.name}/{slot}")
    count = max(1, round(trials * CONTENDED_SHARE))
    return frozenset(source.sample(range(trials), count))


class Planning(Defaults):
    """See docs/design/evaluation.md."""

    name = "planning"
    title = "Motion planning: one server against 2 and 3 replicas"
    claim = (
        "OMPL plans in the scenes Cubicles, Home and TwistyCool, on one server and on two "
        "replicas, 100 trials each with a time-out of 100 s. With two, the mean is up to 1.22 "
        "times shorter (Cubicles), and the P99 5.53 times on Cubicles and 1.42 times on TwistyCool."
    )
    method = (
        "OMPL's RRT-Connect with FCL as an ordinary ROS 2 service, nav_msgs/srv/GetPlan, in three "
        "pools of one, two and three replicas in different regions. The scenes are made of boxes "
        "after the character of OMPL.app's, whose meshes may not be passed on (--omplapp DIR takes "
        "them from a checkout). Every answer is checked for collisions. Who is late is told to "
        "stop, and the next trial waits until all are idle. 'Contended': in 2 of 100 of its "
        f"requests a replica loses processor time, so that it is {CONTENDED_FACTOR:g} times "
        "slower, independently of the others. Validity checks are those of the winner: work that "
        "does not depend on this machine's load."
    )
    fields = ("ok", "latency_s", "checks", "search_s", "winner", "contended", "stolen_s", "fault")
    measures = ("latency_s", "checks")

    def __init__(self) -> None:
        super().__init__(
            modules={"fcl": "motion", "ompl": "motion"},
            options={"omplapp": "a checkout of OMPL.app, for its own scenes"},
        )

    def trials(self, scale: Scale) -> Mapping[str, int]:
        """Every scene, clean and contended; for `quick` one scene."""
        count = scale.choose(quick=8, normal=100, full=300)
        scenes = scale.choose(quick=SCENES[:1], normal=SCENES, full=SCENES)
        return {
            Condition(scene, replicas, contended).name: count
            for scene in scenes
            for contended in (False, True)
            for replicas in REPLICAS
        }

    @contextlib.contextmanager
    def session(self, stage: Stage) -> Iterator[Run]:
        """Start the three pools and one client of all."""
        counts = self.trials(stage.scale)
        with stage.pools() as pools, _importable(TEMPLATE):
            omplapp = stage.options.get("omplapp", "")
            files = {replicas: _pool_file(pools, replicas, omplapp) for replicas in REPLICAS}
            pools.up(*files.values())
            records = {replicas: file.with_name(RECORD) for replicas, file in files.items()}
            with Caller(pools.domain) as caller:
                trial = _Trial(pools, caller, records, omplapp)
                trial.warm_up()
                yield lambda name, number: trial.run(Condition.of(name), number, counts[name])

    def findings(self, samples: Samples) -> Sequence[Finding]:
        """Return the ratios that the paper prints, and ours of the same scenes."""
        found = []
        for scene in _scenes(samples):
            for contended in (False, True):
                found += list(_findings(samples, scene, contended))
        return found

    def tables(self, samples: Samples) -> Sequence[Table]:
        """Return every ratio by seconds and by checks, and what independence alone would give."""
        rows = []
        for scene in _scenes(samples):
            for contended in (False, True):
                single = Condition(scene, 1, contended).name
                for replicas in REPLICAS[1:]:
                    several = Condition(scene, replicas, contended).name
                    for field in ("latency_s", "checks"):
                        one, many = samples.column(single, field), samples.column(several, field)
                        rows.append(
                            [
                                PAPERS_NAMES[scene],
                                "contended" if contended else "clean",
                                str(replicas),
                                {"latency_s": "seconds", "checks": "validity checks"}[field],
                                str(ratio(one, many, mean)),
                                str(ratio(one, many, p99)),
                                _independent(one, replicas),
                            ]
                        )
        failed = [
            [name, str(len(rows_)), str(sum(not r["ok"] for r in rows_))]
            for name, rows_ in samples.items()
        ]
        return [
            Table(
                "One server over replicas; last, what independent replicas as fast as the one "
                "server would give, drawn from its own trials",
                ["scene", "variant", "replicas", "by", "mean", "P99", "independent: mean / P99"],
                rows,
            ),
            Table("Requests", ["condition", "asked", "no answer, or a wrong one"], failed),
        ]

    def figures(self, samples: Samples) -> Mapping[str, Any]:
        """Draw histograms and cumulative distributions as in the paper's figure."""
        return planning_figures.draw(samples, _scenes(samples))


def _scenes(samples: Samples) -> list[str]:
    return [s for s in SCENES if any(Condition.of(name).scene == s for name in samples)]


# -- what is compared with the paper -------------------------------------------------------------

_PAPER = {("cubicles", "mean"): "1.22", ("cubicles", "P99"): "5.53", ("twist", "P99"): "1.42"}


def _findings(samples: Samples, scene: str, contended: bool) -> Iterator[Finding]:
    one = samples.column(Condition(scene, 1, contended).name, "latency_s")
    two = samples.column(Condition(scene, 2, contended).name, "latency_s")
    for word, statistic in (("mean", mean), ("P99", p99)):
        if (paper := _PAPER.get((scene, word))) is None:
            continue
        ours = ratio(one, two, statistic)
        variant = "a contended VM now and then" if contended else "clean"
        why = _why(float(paper), ours, word, contended=contended)
        if word == "P99" and len(one) < 300:
            why += f" With {len(one)} trials a P99 is nearly the longest: its interval is wide."
        what = f"{PAPERS_NAMES[scene]}, {word}, {variant}: one server / two replicas"
        yield Finding(what, paper, ours, why=why)


def _why(paper: float, ours: Estimate, word: str, *, contended: bool) -> str:
    if ours.low <= paper <= ours.high:
        return "The paper's figure lies within our interval."
    if ours.high < paper and word == "P99" and not contended:
        return (
            "Sampling alone does not give the paper's ratio: independent searches give "
            "Q(0.99) / Q(0.9) of one server's time. The paper's needs rare outliers of the "
            "system, such as those of the contended variant."
        )
    if ours.high < paper:
        return (
            "Replicas share this machine's two cores and slow one another down, which two VMs do "
            "not: see the ratios by validity checks."
        )
    return (
        "The searches here spread more than the paper's, whose planner, scenes and machines are "
        "others, and so the faster of two gains more."
    )


def _independent(one: Sequence[float], replicas: int) -> str:
    source = random.Random(0)
    drawn = [min(source.choices(one, k=replicas)) for _ in range(20_000)]
    return f"{mean(one) / mean(drawn):.3g} / {p99(one) / p99(drawn):.3g}"


# -- one trial -----------------------------------------------------------------------------------


@contextlib.contextmanager
def _importable(folder: Path) -> Iterator[None]:
    """Let an example's modules be imported as its own programs import them."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))


def _service(replicas: int) -> str:
    return f"/plan_{replicas}"


def _pool_file(pools: Pools, replicas: int, omplapp: str) -> Path:
    """Write a pool of so many replicas of the example, which note their searches in `RECORD`."""
    folder = pools.init("motion", f"motion-{replicas}")
    record = folder / RECORD
    record.touch()
    parameters = ["-r", f"/plan:={_service(replicas)}", "-p", f"record:={record}"]
    parameters += ["-p", f"limit_s:={TIMEOUT_S}"]
    if omplapp:
        parameters += ["-p", f"omplapp:={omplapp}"]
    any_of = ", ".join(f"{{infra: local/{region}}}" for region in REGIONS[:replicas])
    (folder / "pool.yaml").write_text(
        f"name: motion-{replicas}\n"
        f"resources: {{cpus: 4+, use_spot: {str(replicas > 1).lower()}, any_of: [{any_of}]}}\n"
        "workdir: .\n"
        f"run: exec {shlex.quote(sys.executable)} motion_service.py --ros-args "
        f"{shlex.join(parameters)}\n"
        "fogft:\n"
        "  services:\n"
        f"    - {{name: {_service(replicas)}, type: nav_msgs/srv/GetPlan, cancel: /plan_stop,\n"
        f"       timeout_s: {TIMEOUT_S + 5:g}}}\n"
        f"  replicas: {replicas}\n"
    )
    return folder / "pool.yaml"


class _Trial:
    """Asks for one way and says what became of it."""

    def __init__(
        self, pools: Pools, caller: Caller, records: Mapping[int, Path], omplapp: str
    ) -> None:
        from rigid_body import Planner, unturned
        from scenes import NAMES, load

        self._pools, self._caller, self._records = pools, caller, records
        scenes = {name: load(name, omplapp) for name in NAMES}
        self._judges = {name: Planner(scene) for name, scene in scenes.items()}
        self._ends = {n: (unturned(s.start), unturned(s.goal)) for n, s in scenes.items()}
        self._pids = {
            (replicas, slot): self._pid(replicas, slot)
            for replicas in REPLICAS
            for slot in range(replicas)
        }

    def _pid(self, replicas: int, slot: int) -> int:
        found = self._pools.service_pids(f"motion-{replicas}", slot, "motion_service.py")
        if len(found) != 1:
            raise EvaluationError(f"replica {slot} of {replicas} has {len(found)} planners")
        return found[0]

    def warm_up(self) -> None:
        """Ask every pool once, so that no trial pays for first-time work."""
        from nav_msgs.srv import GetPlan

        for replicas in REPLICAS:
            self._caller.wait(_service(replicas), GetPlan)
            self.run(Condition(SCENES[0], replicas, contended=False), 0, 1)

    def run(self, condition: Condition, number: int, trials: int) -> Row:
        """Run one trial."""
        from motion_client import request_for
        from motion_service import digest, pose_of
        from nav_msgs.srv import GetPlan

        start, goal = self._ends[condition.scene]
        slots = [
            slot
            for slot in range(condition.replicas)
            if number in contended_trials(condition, slot, trials)
        ]
        record = self._records[condition.replicas]
        noted = record.stat().st_size
        with steal([self._pids[condition.replicas, s] for s in slots], CONTENDED_FACTOR) as stolen:
            response, latency_s = self._caller.call(
                _service(condition.replicas),
                GetPlan,
                request_for(condition.scene, start, goal),
                TIMEOUT_S + 10,
            )
        self._settle(condition.replicas)
        way = [pose_of(stamped) for stamped in response.plan.poses] if response else []
        fault = self._judges[condition.scene].fault(way, start, goal)
        search = _search(record, noted, digest(way)) if way else {}
        winner = self._slot_of(condition.replicas, search.get("pid", 0))
        return {
            "ok": not fault,
            "latency_s": latency_s,
            "checks": search.get("checks", ""),
            "search_s": search.get("seconds", ""),
            "winner": winner,
            "contended": len(slots),
            "stolen_s": stolen.seconds,
            "fault": fault,
        }

    def _slot_of(self, replicas: int, pid: int) -> int | str:
        return next((s for s in range(replicas) if self._pids[replicas, s] == pid), "")

    def _settle(self, replicas: int) -> None:
        """Wait until no planner of the pool works: the next trial begins with idle replicas."""
        pids = [self._pids[replicas, slot] for slot in range(replicas)]
        idle, limit = 0, time.monotonic() + TIMEOUT_S
        while idle < 3:
            idle = 0 if any(map(_runs, pids)) else idle + 1
            if time.monotonic() > limit:
                raise EvaluationError("a planner that was told to stop did not")
            time.sleep(0.005)


def _runs(pid: int) -> bool:
    """Whether a thread of a process runs or waits for a core."""
    try:
        threads = list(Path(f"/proc/{pid}/task").iterdir())
        return any(
            (thread / "stat").read_text().rpartition(") ")[2].startswith("R") for thread in threads
        )
    except OSError:
        if not Path(f"/proc/{pid}").exists():
            raise EvaluationError("a planner has ended in mid-experiment") from None
        return True  # one of its threads has just ended


def _search(record: Path, offset: int, answer: str) -> dict[str, Any]:
    """Return what the replica that gave an answer has noted of its search."""
    with record.open() as file:
        file.seek(offset)
        for line in file:
            search: dict[str, Any] = json.loads(line)
            if search["answer"] == answer:
                return search
    raise EvaluationError("the answer is none that a replica has noted: wrong, or lost")


EXPERIMENT = Planning()
