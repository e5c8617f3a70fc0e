"""A replica launched again and again at another port: how soon its robot asks it there.

``python -m tests.proxy.moves --times 20`` starts a rendezvous, a robot, and one replica after the
other in the same slot. Each is timed from the moment that the rendezvous hears of its services to
the moment that the robot has been answered a probe by it. Requests go on all the time; the robot is
left alone.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from fogft.model.replica import Member, Membership, ReplicaId
from fogft.records.record import RecordKind
from fogft.records.roster import admission_content, slot_state
from tests.link.wire_pool import POOL_UID, wait_for
from tests.proxy.gateway_pool import GatewayPool, Robot, ServerProxy
from tests.records.rendezvous_pool import Party, Rendezvous, manager_files

LIMIT_S = 60.0


def run(folder: Path, times: int) -> dict[str, Any]:
    """Move a replica so often; return what was seen.

    Raises:
        AssertionError: A request failed, or the robot never found the replica.
    """
    pool = GatewayPool(folder, timeout_s=60.0)
    place = Rendezvous(pool.authority, "a")
    manager = Party(manager_files(pool.authority), place.endpoint)
    replicas: list[ServerProxy] = []
    took = []

    def meeting(stem: str) -> str:
        return f"rendezvous: ['{place.endpoint}']\nrecords: {stem}-records.json\n"

    def launch(generation: int) -> None:
        replicas.append(ServerProxy(pool, 0, meeting(f"r{generation}"), generation=generation))
        members = (Member(ReplicaId(POOL_UID, 0, generation), ""),)
        content = admission_content(Membership("p", POOL_UID, 2, generation, members))
        manager.client.publish(RecordKind.ADMISSION, "", 2, content, sequence=generation)

    try:
        launch(1)
        robot = pool.robot("ada", extra=meeting("ada"))
        wait_for(robot.ready, LIMIT_S)
        for generation in range(2, times + 2):
            replicas[-1].kill()
            robot.ask(2)
            launch(generation)
            wait_for(lambda generation=generation: _serves(manager, generation), LIMIT_S)  # type: ignore[misc]
            began = time.monotonic()
            wait_for(lambda generation=generation: _used(robot, generation), LIMIT_S)  # type: ignore[misc]
            took.append(time.monotonic() - began)
        robot.all_right()
        told = robot.tell()
        return {
            "moves": times,
            "median_s": round(statistics.median(took), 3),
            "longest_s": round(max(took), 3),
            "asked": told["asked"],
            "answered_rightly": told["right"],
        }
    finally:
        manager.client.close()
        pool.close()
        for replica in replicas:
            replica.kill()
        place.kill()


def _serves(party: Party, generation: int) -> bool:
    slots = party.client.known.of(RecordKind.SLOT)
    return any(one.generation == generation and slot_state(one).services for one in slots)


def _used(robot: Robot, generation: int) -> bool:
    links = robot.tell()["report"]["links"]
    return any(link["generation"] == generation and link["ready"] for link in links)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--times", type=int, default=20)
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(run(Path(folder) / "pool", parser.parse_args().times), indent=1))


if __name__ == "__main__":
    main()
