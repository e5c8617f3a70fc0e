"""Both sides behind NAT: a pool that launches its own gateway, on unmodified SkyPilot.

Runs inside a world (`world.sh`). Nothing lets a VM open a connection to the robot, and nothing but
ssh lets the robot open one to a replica; both dial the gateway, which `up` launches first. Its VM
is taken away, and comes back at another address. Prints a table of steps; ends with status 1 at
the first thing wrong.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any

from tests.e2e.pool import Client
from tests.sky.emulated_aws.emulation import Steps, control, running, until
from tests.sky.emulated_aws.pool import HOME, Pool, machine_of, reaches

GATEWAY = "1999"
NATTED = """\
name: natted
resources:
  cpus: 2
  use_spot: true
  any_of: [{infra: aws/us-east-1}, {infra: aws/us-west-2}]
workdir: .
run: exec python3 plan_service.py
fogft:
  replicas: 1
  gateway: {launch: true}
  services:
    - {name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 10}
"""
# A NAT beside the robot: VMs reach AWS's interface and metadata, and answer what it has begun.
NAT = """\
table inet nat_of_robot { chain input {
  type filter hook input priority 0; policy accept;
  ip saddr 10.66.0.0/16 ip daddr 10.66.0.1 tcp dport != 5566 ct state new drop
}
}
"""
step = Steps()


def gateways() -> list[dict[str, Any]]:
    return [one for one in running() if one["labels"]["fogft-slot"] == GATEWAY]


def answers(pool: Pool) -> dict[str, Any]:
    """Ask for a while; return what came of it."""
    return Client(pool.environ, 10.0, 5.0, 15.0).result()


def main() -> int:
    subprocess.run(["nft", "-f", "-"], input=NAT, text=True, check=True)
    pool = Pool(NATTED)
    try:
        with step("`up --yes`, until the service answers through the gateway"):
            print(pool.fogft("up", str(pool.file), "--yes"))
        (gateway,) = gateways()
        (name,) = pool.replicas()
        replica = machine_of(name)
        assert not gateway["spot"]
        assert all(reaches(gateway["ip"], port) for port in (22, 7470, 7471, 7472))
        assert reaches(replica["ip"], 22)
        assert not reaches(replica["ip"], 7448)
        print(pool.fogft("status"))
        result = answers(pool)
        print(result)
        assert result["answered"] == result["requests"] > 10, result
        with step("the gateway's VM is taken away, until another answers elsewhere"):
            control(f"/preempt?id={gateway['id']}")
            until("it is another one", lambda: [g for g in gateways() if g["id"] != gateway["id"]])
            until("the replica dials it", lambda: pool.whole(1) and name not in pool.replicas())
        result = answers(pool)
        print(result)
        assert result["answered"] == result["requests"] > 10, result
        print(pool.fogft("cost"))
        with step("`down`, verified with the cloud"):
            print(pool.fogft("down"))
    finally:
        pool.keep_log()
    assert not running()
    assert not list((HOME / "pools").glob("*"))
    pool.leave_nothing()
    step.write("gateway")
    print("every step passed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
