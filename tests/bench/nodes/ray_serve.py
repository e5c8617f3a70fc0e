"""Ray Serve with three replicas of a service that does one thing at a time: ``scripts/compare``.

Run by the Python of an environment that has ``ray[serve]``; nothing of fogft is in it. The
arguments are those of `tests.bench.load`, with a folder for notes of deaths before them.
"""

from __future__ import annotations

import asyncio
import os
import random
import sys
from pathlib import Path

import ray
from ray import serve


def main() -> None:
    """Serve until the process is ended."""
    port, folder = sys.argv[1], Path(sys.argv[2])
    median_s, sigma, stalled, stall_s = map(float, sys.argv[3:7])
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    ray.init(num_cpus=4, include_dashboard=False, log_to_driver=False)
    serve.start(http_options={"host": "127.0.0.1", "port": int(port)})

    @serve.deployment(num_replicas=3, max_ongoing_requests=1, ray_actor_options={"num_cpus": 1})
    class Service:
        async def __call__(self, request: object) -> str:
            if await request.body() == b"0":  # type: ignore[attr-defined]
                with (folder / f"deaths-{os.getpid()}").open("ab") as file:
                    file.write(b".")
                os._exit(1)
            seconds = median_s * random.lognormvariate(0.0, sigma)
            await asyncio.sleep(seconds + (stall_s if random.random() < stalled else 0.0))
            return "1"

    serve.run(Service.bind())
    print("ready", flush=True)
    asyncio.new_event_loop().run_forever()


if __name__ == "__main__":
    main()
