"""Does ROS 2 work here? Run as a process of its own, so that a caller stays light.

``python -m fogft.ros.self_test describe`` prints what ROS 2 there is. ``answer NAME`` and
``ask NAME`` are the two ends of one service call between two processes, in the
environment as it stands: what a pool's robot side does. ``segment`` makes a node and prints how
large a shared-memory segment it maps. They need nothing but rclpy: every node offers its parameters
as services.

Each prints one JSON object on stdout. Exit status 0 when it worked.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from fogft.ros import environment

_LIMIT_S = 5.0


def answer(name: str) -> None:
    """Offer a service until stdin is closed."""
    import threading

    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node(name, context=context, enable_rosout=False)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    print(json.dumps({"offering": name}), flush=True)
    closed = threading.Event()

    def until_closed() -> None:
        sys.stdin.read()
        closed.set()

    threading.Thread(target=until_closed, daemon=True).start()
    while not closed.is_set():
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def ask(name: str) -> int:
    """Call that service; print how long discovery and the call took, in seconds, or what failed.

    That is printed before the node is taken down: Fast DDS now and then crashes there, which
    is no answer to the question.
    """
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node(
        f"{name}_ask", context=context, enable_rosout=False, start_parameter_services=False
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        return _tell(lambda: _call(name, node, executor))
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def segment() -> dict[str, int]:
    """Make a node; return the size of the shared memory that its middleware maps for it."""
    import rclpy

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node(f"fogft_doctor_{os.getpid()}", context=context, enable_rosout=False)
    try:
        return {"segment_bytes": environment.largest_segment_bytes()}
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def _call(name: str, node: Any, executor: Any) -> dict[str, float]:
    """Find the service and call it once.

    Raises:
        TimeoutError: Discovery did not find it, or it did not answer.
    """
    from rcl_interfaces.srv import ListParameters

    client: Any = node.create_client(ListParameters, f"/{name}/list_parameters")
    started = time.monotonic()
    while not client.service_is_ready():
        if time.monotonic() - started > _LIMIT_S:
            raise TimeoutError("discovery")
        executor.spin_once(timeout_sec=0.02)
    found = time.monotonic()
    future = client.call_async(ListParameters.Request())
    executor.spin_until_future_complete(future, timeout_sec=_LIMIT_S)
    if not future.done():
        raise TimeoutError("call")
    return {"discovery_s": found - started, "call_s": time.monotonic() - found}


def _tell(find: Callable[[], Mapping[str, Any]]) -> int:
    """Print what is found, or the error that stood in its way; return the exit status."""
    try:
        print(json.dumps(find()), flush=True)
    except Exception as error:
        return _tell_error(error)
    return 0


def _tell_error(error: Exception) -> int:
    print(json.dumps({"error": str(error), "kind": type(error).__name__}), flush=True)
    return 1


def main(arguments: list[str]) -> int:
    """Run one of the four; it prints its result."""
    environment.prepare(os.environ)
    try:
        if arguments[0] == "describe":
            return _tell(environment.describe)
        if arguments[0] == "segment":
            return _tell(segment)
        if arguments[0] == "ask":
            return ask(arguments[1])
        answer(arguments[1])
    except Exception as error:
        return _tell_error(error)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
