"""A client as users write it: ``plain_client.py NAME COUNT CALLBACK_S ROUNDS [SERVICE]``.

Default quality of service, rclpy's own executor: it sends COUNT requests of ``/burst`` at once,
spends CALLBACK_S in each response's callback, and does so again ROUNDS times. It waits for a line
on stdin, so that several begin at once, prints how many of all were answered, and waits again.
"""

from __future__ import annotations

import sys
import time

import rclpy
from std_srvs.srv import SetBool

LIMIT_S = 30.0


def answered(node: rclpy.node.Node, client: rclpy.client.Client, count: int, hold_s: float) -> int:
    done: list[int] = []

    def take(_: rclpy.task.Future) -> None:
        time.sleep(hold_s)
        done.append(1)

    for _ in range(count):
        client.call_async(SetBool.Request(data=True)).add_done_callback(take)
    until = time.monotonic() + LIMIT_S
    while len(done) < count and time.monotonic() < until:
        rclpy.spin_once(node, timeout_sec=0.2)
    return len(done)


def main() -> None:
    name, count, hold_s, rounds, *service = sys.argv[1:]
    rclpy.init()
    node = rclpy.create_node(name)
    client = node.create_client(SetBool, *(service or ["/burst"]))
    if not client.wait_for_service(LIMIT_S):
        sys.exit("no service was found")
    print("ready", flush=True)
    sys.stdin.readline()
    sums = (answered(node, client, int(count), float(hold_s)) for _ in range(int(rounds)))
    print(sum(sums), flush=True)
    sys.stdin.readline()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
