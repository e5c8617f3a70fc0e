"""Experiment `segmentation`: SAM while another client keeps the servers busy (section IV.C).

Owns: two pools, the second client's rhythm, what a row says. Not here: the network, which is the
ordinary node of `templates/segment`, and the second client (`contending`).
"""

from __future__ import annotations

import contextlib
import io
import random
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from fogft import disk
from tests.estimates import mean, median
from tests.evaluation import comparing, workspaces
from tests.evaluation.caller import Caller
from tests.evaluation.comparing import CONDITIONS, faulted, replicas
from tests.evaluation.contending import Contender
from tests.evaluation.experiment import Defaults, Finding, Row, Run, Scale, Stage, Table
from tests.evaluation.pools import Pools
from tests.evaluation.samples import Samples

TYPE = "segment_interfaces/srv/Segment"
SERVICE = "/segment"
POOLS = ("single", "two")
TIMEOUT_S = 60.0
WIDTH, HEIGHT = 320, 240


class Segmentation(Defaults):
    """See docs/design/evaluation.md."""

    name = "segmentation"
    title = "Segmentation under compute contention"
    claim = (
        "SAM on one server with a GPU and on two replicas, 300 trials, while a second, periodic "
        "client alternates between the servers. With that contention two replicas are 1.31 times "
        "faster on average and 1.96 times in the P99; without, 1.3 times in the P99."
    )
    method = (
        "The architecture of SAM as an ordinary ROS 2 service on one core. Its weights are random "
        "unless --sam DIR names a checkpoint: latencies are those of the network, masks mean "
        "nothing, and an answer is checked for its size and for being the same each time. With "
        "the fault a second client asks the machines themselves, in turns, one image in every "
        "time that an image takes, so that each machine works for it half of the time; the "
        "machine that is no replica of ours takes its turns with one server. The trial's request "
        "comes at a random moment. `busy` counts the replicas that worked for the second client "
        "when the request was sent. The next trial waits until all machines are idle. With "
        "--full the network is SAM's ViT-B at 256 pixels, else a smaller one of the same form."
    )
    fields = ("ok", "latency_s", "busy", "alone_s", "model", "fault")
    measures = ("latency_s", "busy")

    def __init__(self) -> None:
        super().__init__(
            modules={"torch": "vision", "transformers": "vision", "PIL": "vision"},
            options={"sam": "a folder with a SAM checkpoint in the format of transformers"},
        )

    def trials(self, scale: Scale) -> Mapping[str, int]:
        """As many as the paper's, but for `quick`."""
        return dict.fromkeys(CONDITIONS, scale.choose(quick=8, normal=300, full=300))

    @contextlib.contextmanager
    def session(self, stage: Stage) -> Iterator[Run]:
        """Start both pools and the second client."""
        workspace = workspaces.ready("segment")
        type = workspaces.adopt(workspace, TYPE)
        more = ["--size", stage.scale.choose(quick="tiny", normal="tiny", full="base-256")]
        if "sam" in stage.options:
            more += ["--weights", stage.options["sam"]]
        with stage.pools() as pools:
            files = [_pool_file(pools, workspace, count, more) for count in (1, 2)]
            pools.up(*files)
            machines = dict(_machines(pools))
            question = _question(type)
            services = {name: f"{SERVICE}_{name.partition('/')[0]}" for name in machines}
            with (
                Caller(pools.domain) as caller,
                Contender(machines, services, type, question) as contender,
            ):
                trial = _Trial(caller, contender, list(machines), type)
                trial.warm_up()
                yield trial.run

    def findings(self, samples: Samples) -> Sequence[Finding]:
        """Compare the four ratios, and say how contended the servers were."""
        paper = {"": ("-", "1.3"), "-fault": ("1.31", "1.96")}
        found = comparing.findings(samples, paper, _whys(samples))
        for condition in ("single-fault", "two-fault"):
            busy = mean(samples.column(condition, "busy")) / replicas(condition)
            what = f"{comparing.LABELS[condition]}: a server was busy with the second client"
            found.append(Finding(what, "-", f"{busy:.0%}", "", "Of requests, when they were sent."))
        return found

    def tables(self, samples: Samples) -> Sequence[Table]:
        """Return what failed, and what answered."""
        models = sorted({str(row["model"]) for rows in samples.values() for row in rows})
        return [comparing.requests(samples), Table("Network", ["model"], [[m] for m in models])]

    def figures(self, samples: Samples) -> Mapping[str, Any]:
        """Draw as the paper does."""
        return {"latency": comparing.figure(samples, f"{self.title} (see Network for weights)")}


def _whys(samples: Samples) -> Mapping[str, str]:
    alone = median(samples.column("single", "latency_s"))
    shared = (
        "The two replicas and the second client's work share this machine's two cores, and slow "
        "one another down, which VMs with GPUs of their own do not"
    )
    queue = (
        "A request that meets the second client's waits for the rest of it: between 0 and one "
        f"image ({alone:.2g} s here), so one server's mean is at most about 1.25 times, and its "
        "P99 twice, that of an idle one"
    )
    return {
        "mean healthy": f"The paper prints none. {shared}.",
        "P99 healthy less": f"The paper's GPU has a tail of its own, ours has none. {shared}.",
        "P99 healthy more": "This machine's own pauses fell on the one server more.",
        "mean less": f"{queue}. {shared}.",
        "mean more": f"{shared}; and the contention hit the one server harder than the paper's.",
        "P99 less": f"{queue}. {shared}, so the two replicas keep a tail.",
        "P99 more": f"{queue}; with the load of other programs it is more.",
    }


# -- one session ---------------------------------------------------------------------------------


def _pool_file(pools: Pools, workspace: Path, count: int, more: Sequence[str]) -> Path:
    name = POOLS[count - 1]
    service = f"{SERVICE}_{name}"
    run = shlex.join([sys.executable, "segment_service.py", "--service", service, *more])
    entry = f"{{name: {service}, type: {TYPE}, timeout_s: {TIMEOUT_S:g}}}"
    return comparing.pool_file(pools, f"segment-{name}", count, workspace, run, entry)


def _machines(pools: Pools) -> Iterator[tuple[str, int]]:
    """Yield the replicas' machines as ``pool/slot`` with the ROS domain of each."""
    for name in POOLS:
        status = pools.status(f"segment-{name}")
        for replica in status["replicas"]:
            id = f"{status['uid']}-{replica['slot']}.{replica['generation']}"
            state = disk.read_json(pools.home / "local" / "machines" / id / "state.json")
            yield f"{name}/{replica['slot']}", int(state["domain_id"])


def _question(type: Any) -> Any:
    """Return what is asked, by us and by the second client."""
    from PIL import Image, ImageDraw

    image = Image.new("RGB", (WIDTH, HEIGHT), (200, 200, 200))
    chance = random.Random(1)
    for _ in range(5):
        x, y, r = chance.randint(40, WIDTH - 40), chance.randint(40, HEIGHT - 40), 30
        colour = tuple(chance.randrange(256) for _ in range(3))
        ImageDraw.Draw(image).ellipse((x - r, y - r, x + r, y + r), fill=colour)
    out = io.BytesIO()
    image.save(out, "PNG")
    asked = type.Request(x=float(x), y=float(y))
    asked.image.format = "png"
    asked.image.data = out.getvalue()
    return asked


class _Trial:
    """Asks for one mask and says what became of it."""

    def __init__(
        self, caller: Caller, contender: Contender, machines: Sequence[str], type: Any
    ) -> None:
        self._caller, self._contender, self._type = caller, contender, type
        self._machines = {n: [m for m in machines if m.startswith(f"{n}/")] for n in POOLS}
        self._question = _question(type)
        self._alone_s = 0.0
        self._first: Any = None

    def warm_up(self) -> None:
        """Ask every pool, and learn how long an image takes with nobody else about."""
        took = []
        for name in POOLS:
            self._caller.wait(f"{SERVICE}_{name}", self._type)
            for _ in range(5):
                self._first, took_s = self._ask(name)
                self._settle(name)
                took.append(took_s)
        self._alone_s = median(took)

    def run(self, condition: str, number: int) -> Row:
        """Ask once, with the second client about or not."""
        pool = POOLS[replicas(condition) - 1]
        machines, chance = self._machines[pool], random.Random(f"{condition}/{number}")
        if faulted(condition):
            turns = machines if len(machines) == 2 else [machines[0], None]
            # It is anywhere in its rhythm when our request comes.
            self._contender.begin(chance.choice([turns, turns[::-1]]), self._alone_s)
            time.sleep(chance.uniform(1, 3) * self._alone_s)
        busy = self._contender.busy(machines)
        answer, took_s = self._ask(pool)
        self._contender.stop()
        self._settle(pool)
        fault = self._wrong(answer)
        return {
            "ok": not fault,
            "latency_s": took_s,
            "busy": busy,
            "alone_s": self._alone_s,
            "model": answer.model if answer is not None else "",
            "fault": fault,
        }

    def _ask(self, pool: str) -> tuple[Any, float]:
        return self._caller.call(f"{SERVICE}_{pool}", self._type, self._question, TIMEOUT_S)

    def _settle(self, pool: str) -> None:
        """Wait until every machine is idle: what is no image is answered at once, in its turn."""
        for machine in self._machines[pool]:
            self._contender.ask(machine, self._type.Request())

    def _wrong(self, answer: Any) -> str:
        if answer is None:
            return "no answer"
        if (answer.width, answer.height) != (WIDTH, HEIGHT):
            return f"a mask of {answer.width} x {answer.height}"
        return "" if bytes(answer.mask) == bytes(self._first.mask) else "another mask"


EXPERIMENT = Segmentation()
