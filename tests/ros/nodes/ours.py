"""A serialised end as a process: ``ours.py serve|call COUNT``, in the domain that ROS is told.

``serve`` offers ``/burst`` (std_srvs/srv/SetBool), prints ``ready`` and ends with stdin. ``call``
sends COUNT requests at once and prints how many were answered; 0 where no server was found.
"""

from __future__ import annotations

import os
import sys
import threading
import time

from fogft.ros import environment

environment.prepare(os.environ)

TYPE = "std_srvs/srv/SetBool"
REQUEST = b"\x00\x01\x00\x00\x01"


def serve(node) -> None:
    from fogft.ros.messages import default_response

    response = default_response(TYPE)
    server = []
    server.append(node.serve("/burst", TYPE, lambda _, handle: server[0].respond(handle, response)))
    print("ready", flush=True)
    sys.stdin.read()


def call(node, count: int, limit_s: float) -> None:
    client = node.client("/burst", TYPE)
    deadline = time.monotonic() + limit_s
    while not client.available() and time.monotonic() < deadline:
        time.sleep(0.02)
    if not client.available():
        print(0, flush=True)
        return
    answered, every = [], threading.Event()

    def heard(_: bytes) -> None:
        answered.append(1)
        if len(answered) == count:
            every.set()

    for _ in range(count):
        client.call(REQUEST, heard)
    every.wait(limit_s)
    print(len(answered), flush=True)


def main() -> None:
    from fogft.ros.node import SerialisedNode

    node = SerialisedNode(f"ours_{sys.argv[1]}")
    try:
        if sys.argv[1] == "serve":
            serve(node)
        else:
            call(node, int(sys.argv[2]), float(sys.argv[3]))
    finally:
        node.close()


if __name__ == "__main__":
    main()
