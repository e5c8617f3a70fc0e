"""Test whether ROS 2 works here. Runs as its own process, to keep the caller light.

``python -m fogft.ros.self_test describe`` prints what ROS 2 there is. ``answer NAME`` and
``ask NAME`` are the two ends of one service call between two processes: every node offers its
parameters as services. ``segment`` prints how large a shared-memory segment a node maps.

Each prints one JSON object on stdout. Exit status 0 when it worked.
"""

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from fogft.process import on_thread
from fogft.ros import environment

_LIMIT_S = 5.0


@contextlib.contextmanager
def _node(name: str) -> Iterator[tuple[Any, Any]]:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    from fogft.ros.joining import new_context

    context = new_context(None)
    node = rclpy.create_node(name, context=context, enable_rosout=False)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def answer(name: str) -> int:
    """Offer a service until stdin is closed."""
    with _node(name) as (_, executor):
        print(json.dumps({"offering": name}), flush=True)
        reader = on_thread(sys.stdin.read)
        while reader.is_alive():
            executor.spin_once(timeout_sec=0.1)
    return 0


def segment() -> dict[str, int]:
    """Create a node; return the size in bytes of its middleware's shared memory."""
    with _node(f"fogft_doctor_{os.getpid()}"):
        return {"segment_bytes": environment.largest_segment_bytes()}


def _call(name: str, node: Any, executor: Any) -> dict[str, float]:
    """Call the service once; return the seconds taken by discovery and by the call.

    Raises TimeoutError: The service was not found, or did not answer.
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
    """Print the result of `find`, or its error; return the exit status."""
    try:
        found, status = find(), 0
    except Exception as error:
        found, status = {"error": str(error), "kind": type(error).__name__}, 1
    print(json.dumps(found), flush=True)
    return status


def main(arguments: list[str]) -> int:
    """Run one of the four tests and print its result."""
    environment.prepare(os.environ)
    match arguments:
        case ["describe"]:
            return _tell(environment.describe)
        case ["segment"]:
            return _tell(segment)
        case ["ask", name]:
            # Told before the node is destroyed: Fast DDS may crash there, which says nothing.
            with contextlib.ExitStack() as until_told:
                return _tell(lambda: _call(name, *until_told.enter_context(_node(f"{name}_ask"))))
        case ["answer", name]:
            return answer(name)
    print(__doc__, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
