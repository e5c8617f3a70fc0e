"""A node as users write it, as a process: ``ordinary.py serve DOMAIN``, ``call DOMAIN CELLS``.

Serves or calls ``/map`` (nav_msgs/srv/SetMap). ``serve`` prints ``ready``, answers true
when the map's cells are as expected, and ends when stdin closes. ``call`` prints the answer.
"""

from __future__ import annotations

import sys
import threading

import numpy
import rclpy
from nav_msgs.srv import SetMap


def cells(count: int) -> numpy.ndarray:
    return (numpy.arange(count) % 101).astype(numpy.int8)


def serve(node: rclpy.node.Node) -> None:
    def answer(request: SetMap.Request, response: SetMap.Response) -> SetMap.Response:
        got = numpy.array(request.map.data, dtype=numpy.int8)
        response.success = bool(numpy.array_equal(got, cells(request.map.info.width)))
        return response

    node.create_service(SetMap, "/map", answer)
    print("ready", flush=True)
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    while not ended.is_set():
        rclpy.spin_once(node, timeout_sec=0.1)


def call(node: rclpy.node.Node, count: int) -> None:
    client = node.create_client(SetMap, "/map")
    if not client.wait_for_service(30.0):
        sys.exit("no service was found")
    request = SetMap.Request()
    request.map.info.width = count
    request.map.data = cells(count).tolist()
    future = client.call_async(request)
    rclpy.spin_until_future_complete(node, future, timeout_sec=30.0)
    print(future.result().success if future.done() else "no answer", flush=True)


def main() -> None:
    rclpy.init(domain_id=int(sys.argv[2]))
    node = rclpy.create_node("ordinary")
    if sys.argv[1] == "serve":
        serve(node)
    else:
        call(node, int(sys.argv[3]))
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
