"""The client of the experiments: an ordinary rclpy node with a clock around each call."""

from __future__ import annotations

import threading
import time
from typing import Any

from tests.evaluation.errors import EvaluationError


class Caller:
    """Calls services in one ROS domain. Use as a context manager.

    Args:
        domain: The ROS domain.
        name: Of the node.
    """

    def __init__(self, domain: int, name: str = "evaluation") -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSHistoryPolicy, QoSProfile

        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node(name, context=self._context)
        self._keep_all = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._clients: dict[str, Any] = {}
        self._thread = threading.Thread(target=self._spin, name="caller", daemon=True)
        self._thread.start()

    def __enter__(self) -> Caller:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def wait(self, service: str, type: Any, limit_s: float = 60.0) -> None:
        """Wait until a service is there.

        Raises:
            EvaluationError: It did not appear.
        """
        if not self._client(service, type).wait_for_service(timeout_sec=limit_s):
            raise EvaluationError(f"the service {service} did not appear within {limit_s:g} s")

    def call(
        self, service: str, type: Any, request: Any, timeout_s: float
    ) -> tuple[Any | None, float]:
        """Call a service; return its response, or None, and how long that took in seconds."""
        client, answered = self._client(service, type), threading.Event()
        ended = 0.0

        def done(_: Any) -> None:
            nonlocal ended
            ended = time.perf_counter()
            answered.set()

        began = time.perf_counter()
        future = client.call_async(request)
        future.add_done_callback(done)
        if not answered.wait(timeout_s):
            client.remove_pending_request(future)
            return None, time.perf_counter() - began
        return future.result(), ended - began

    def close(self) -> None:
        """Leave ROS."""
        self._executor.shutdown(timeout_sec=5.0)
        self._thread.join(timeout=5.0)
        self._node.destroy_node()
        self._context.try_shutdown()

    def _client(self, service: str, type: Any) -> Any:
        if service not in self._clients:
            self._clients[service] = self._node.create_client(
                type, service, qos_profile=self._keep_all
            )
            self._executor.wake()
        return self._clients[service]

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException, ShutdownException

        try:
            self._executor.spin()
        except (ExternalShutdownException, ShutdownException):
            return
