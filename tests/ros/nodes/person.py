"""What somebody sees who looks at a ROS domain with the usual tools: an ordinary rclpy node."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from tests.ros.conftest import LIMIT_S


class Person:
    """Looks at one domain."""

    def __init__(self, domain: int) -> None:
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor

        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node: Any = rclpy.create_node("person", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}
        self.statuses: dict[str, Any] = {}
        self.log: list[tuple[int, str, str]] = []

    def watch_diagnostics(self) -> None:
        from diagnostic_msgs.msg import DiagnosticArray

        def heard(message: Any) -> None:
            self.statuses |= {status.name: status for status in message.status}

        self.node.create_subscription(DiagnosticArray, "/diagnostics", heard, 10)

    def watch_log(self) -> None:
        from rcl_interfaces.msg import Log
        from rclpy.qos import DurabilityPolicy, QoSProfile

        def heard(message: Any) -> None:
            self.log.append((message.level, message.name, message.msg))

        kept = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(Log, "/rosout", heard, kept)

    def wait(self, condition: Callable[[], Any], what: str) -> Any:
        """Spin until a condition holds; return what it gave."""
        deadline = time.monotonic() + 2 * LIMIT_S
        while not (found := condition()):
            assert time.monotonic() < deadline, f"waited in vain: {what}"
            self._executor.spin_once(timeout_sec=0.05)
        return found

    def ask(self, service: Any, name: str, request: Any) -> Any:
        """Call a service, which may still have to be found."""
        client = self._clients.get(name)
        if client is None:
            client = self._clients[name] = self.node.create_client(service, name)
        self.wait(client.service_is_ready, f"service {name}")
        future = client.call_async(request)
        self.wait(future.done, f"an answer of {name}")
        return future.result()

    def set(self, node: str, **values: Any) -> Any:
        """Set parameters of a node as `ros2 param set` does; keys have `__` for dots."""
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter

        given = [Parameter(k.replace("__", "."), value=v) for k, v in values.items()]
        request = SetParameters.Request(parameters=[p.to_parameter_msg() for p in given])
        [result] = self.ask(SetParameters, f"{node}/set_parameters", request).results
        return result

    def get(self, node: str, *names: str) -> list[Any]:
        """Return what parameters are; None for one that is not there."""
        from rcl_interfaces.srv import GetParameters
        from rclpy.parameter import parameter_value_to_python

        found = []
        for name in names:  # where one is not there, rclpy tells of none
            request = GetParameters.Request(names=[name])
            values = self.ask(GetParameters, f"{node}/get_parameters", request).values
            found.append(parameter_value_to_python(values[0]) if values else None)
        return found

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()
