"""Experiment `overhead`: what the proxies cost a call, against ROS 2 directly.

Owns: the pools and the comparison. Not here: the service, which is `templates/echo`.
"""

from __future__ import annotations

import contextlib
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.estimates import median, p99, ratio
from tests.evaluation import plotting
from tests.evaluation.caller import Caller
from tests.evaluation.errors import EvaluationError
from tests.evaluation.experiment import Defaults, Finding, Row, Run, Scale, Stage
from tests.evaluation.pools import Pools
from tests.evaluation.samples import Samples

REPLICAS = (1, 2, 3)
REGIONS = ("us-west-1", "us-west-2", "us-east-1")
LIMIT_S = 10.0
_BUSY = 6.0  # a load average at which waiting for a core drowns the rest


class Overhead(Defaults):
    """See docs/design/evaluation.md."""

    name = "overhead"
    title = "Not in the paper: what the proxies cost a call"
    claim = "The paper calls the latency of both deployments similar, and gives no number."
    method = (
        "std_srvs/srv/SetBool, answered at once by the node of `fogft init echo`: beside the "
        "client in the same ROS domain, and in pools of 1, 2 and 3 replicas, so that a call takes "
        "two more local ROS calls and a round trip over mutual TLS. All on this machine: distance, "
        "which is most of a real call, is zero. `scripts/bench --only overhead` takes the "
        "transport's own round trip apart."
    )
    fields = ("ok", "latency_s")

    def trials(self, scale: Scale) -> Mapping[str, int]:
        """A trial is one call."""
        calls = scale.choose(quick=100, normal=500, full=2000)
        return {"direct": calls, **{f"replicas-{n}": calls for n in REPLICAS}}

    @contextlib.contextmanager
    def session(self, stage: Stage) -> Iterator[Run]:
        """Start the pools, and the same node beside the client."""
        with stage.pools() as pools:
            files = [_pool_file(pools, n) for n in REPLICAS]
            pools.up(*files)
            beside = subprocess.Popen(
                [sys.executable, "echo_service.py", "--ros-args", "-r", "/echo:=/direct"],
                cwd=files[0].parent,
                env=pools.environ,
                stderr=subprocess.DEVNULL,
            )
            try:
                with Caller(pools.domain) as caller:
                    names = {
                        "direct": "/direct",
                        **{f"replicas-{n}": f"/echo_{n}" for n in REPLICAS},
                    }
                    for service in names.values():
                        _warm_up(caller, service)
                    yield lambda condition, number: _call(caller, names[condition], number)
            finally:
                beside.kill()  # now and then rclpy's `spin` does not hear SIGTERM
                beside.wait()

    def findings(self, samples: Samples) -> Sequence[Finding]:
        """Return the cost of a call, as a factor."""
        direct = samples.column("direct", "latency_s")
        return [
            Finding(
                f"{word}, {n} replica{'s' * (n > 1)}: proxied / direct",
                "-",
                ratio(samples.column(f"replicas-{n}", "latency_s"), direct, statistic),
                why=_why(samples),
            )
            for word, statistic in (("median", median), ("P99", p99))
            for n in REPLICAS
        ]  # fmt: skip

    def figures(self, samples: Samples) -> Mapping[str, Any]:
        """Draw the distributions."""
        figure, axes = plotting.figure(1, 1)
        axis = axes[0][0]
        for colour, condition in zip(plotting.COLOURS, samples, strict=False):
            values = [1000 * s for s in samples.column(condition, "latency_s")]
            plotting.distribution(axis, values, colour, condition.replace("-", " "))
        axis.set_xscale("log")
        axis.set_xlabel("milliseconds", fontsize=8)
        axis.set_ylabel("fraction of calls", fontsize=8)
        axis.legend(fontsize=7)
        return {"latency": figure}


def _why(samples: Samples) -> str:
    load = median([float(row["load"]) for condition in samples for row in samples[condition]])
    why = "A call that takes no time itself: the worst case for a proxy."
    if load > _BUSY:
        why += (
            f" At a load average of {load:.0f} a P99, of direct calls too, is mostly waiting for "
            "a core."
        )
    return why


def _pool_file(pools: Pools, replicas: int) -> Path:
    folder = pools.init("echo", f"echo-{replicas}")
    any_of = ", ".join(f"{{infra: local/{region}}}" for region in REGIONS[:replicas])
    (folder / "pool.yaml").write_text(
        f"name: echo-{replicas}\n"
        f"resources: {{use_spot: true, any_of: [{any_of}]}}\n"
        "workdir: .\n"
        f"run: exec {shlex.quote(sys.executable)} echo_service.py --ros-args"
        f" -r /echo:=/echo_{replicas}\n"
        "fogft:\n"
        f"  services: [{{name: /echo_{replicas}, type: std_srvs/srv/SetBool, timeout_s: 10}}]\n"
        f"  replicas: {replicas}\n"
    )
    return folder / "pool.yaml"


def _warm_up(caller: Caller, service: str) -> None:
    from std_srvs.srv import SetBool

    caller.wait(service, SetBool)
    for number in range(20):
        if not _call(caller, service, number)["ok"]:
            raise EvaluationError(f"{service} does not answer")


def _call(caller: Caller, service: str, number: int) -> Row:
    from std_srvs.srv import SetBool

    asked = SetBool.Request(data=number % 2 == 0)
    response, latency_s = caller.call(service, SetBool, asked, LIMIT_S)
    right = response is not None and response.message == f"heard {asked.data}"
    return {"ok": right, "latency_s": latency_s}


EXPERIMENT = Overhead()
