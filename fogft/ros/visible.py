"""A proxy's node for people: `/diagnostics`, parameters, and its log on `/rosout`.

An ordinary rclpy node with its own executor and thread, in the context of the node that takes
requests. Other threads only put work and log records into its queues, so nothing here ever delays
a request, and errors here are logged and go no further.

Owns: that node, its thread and its log level, which our own log's level follows.
Not here: the contents (`fogft.proxy.robot.diagnostics`).
"""

import logging
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from queue import SimpleQueue
from typing import Any

from fogft.errors import RosError
from fogft.process import on_thread
from fogft.ros.port import Status

log = logging.getLogger(__name__)

TOPIC = "/diagnostics"
_LOOK_EVERY_S = 5.0  # work wakes it earlier
_CLOSE_LIMIT_S = 5.0


class VisibleNode:
    """The node that ROS 2 command-line tools and dashboards see.

    Args:
        context: The context of the proxy's own node.
        judge: Called by this node's thread with parameters that somebody sets. Returns why they
            are rejected; empty if they apply from now on.

    Raises RosError: ROS refuses the node.
    """

    def __init__(self, name: str, context: Any, judge: Callable[[Mapping[str, Any]], str]) -> None:
        self._judge = judge
        self._closing = False
        self._queue: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._shown: frozenset[str] = frozenset()
        self._awake = False
        self._ours = False  # whether we are changing parameters ourselves
        try:
            from rclpy.executors import SingleThreadedExecutor

            self._node: Any = _new_node(name, context)
            self._executor: Any = SingleThreadedExecutor(context=context)
            self._executor.add_node(self._node)
            self._diagnostics: Any = _diagnostics_publisher(self._node)
            self._node.add_on_set_parameters_callback(self._on_set)
            self._log = RosLog(self._node.get_logger(), self._wake)
        except Exception as error:
            raise RosError(f"the ROS node `{name}` cannot be created: {error}") from error
        self._thread = on_thread(self._run, name=f"ros-{name}")

    # -- any thread -----------------------------------------------------------------------

    def diagnose(self, statuses: Sequence[Status]) -> None:
        """Publish statuses on `/diagnostics`, if possible and if anybody subscribes."""
        if self._diagnostics is None or not self._thread.is_alive():
            return
        if self._diagnostics.get_subscription_count():
            self._put(lambda: self._publish(statuses))

    def show(self, values: Mapping[str, Any]) -> None:
        """Set the parameters to exactly these values."""
        self._put(lambda: self._show(dict(values)))

    def _put(self, work: Callable[[], None]) -> None:
        self._queue.put(work)
        self._wake()

    def _wake(self) -> None:
        """End the executor's wait. Only a task ends it; its guard condition does not."""
        if not self._awake:
            self._awake = True
            self._executor.create_task(lambda: None)

    def close(self) -> None:
        """Close the node; call it before the context ends. Idempotent."""
        if not self._closing:
            self._closing = True
            self._put(lambda: None)
            self._thread.join(_CLOSE_LIMIT_S)

    # -- its own thread -------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._closing:
                self._awake = False  # first, so that later work wakes us again
                self._work()
                self._log.pass_on()
                self._executor.spin_once(timeout_sec=0 if self._closing else _LOOK_EVERY_S)
        except Exception:
            log.exception("visible_node_ended")
        finally:
            self._log.close()
            self._executor.shutdown(timeout_sec=0)
            self._node.destroy_node()

    def _work(self) -> None:
        while not self._queue.empty():
            try:
                self._queue.get()()
            except Exception as error:
                log.error("visible_node_failed reason=%r", str(error))

    def _publish(self, statuses: Sequence[Status]) -> None:
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes([one.level]),
                name=one.name,
                message=one.message,
                hardware_id=one.hardware_id,
                values=[KeyValue(key=key, value=value) for key, value in one.values.items()],
            )
            for one in statuses
        ]
        self._diagnostics.publish(message)

    def _show(self, values: Mapping[str, Any]) -> None:
        from rcl_interfaces.msg import ParameterDescriptor
        from rclpy.parameter import Parameter

        # Dynamic: `timeout_s 3` works like 3.0, and a wrong type gets our own error message.
        about = ParameterDescriptor(
            description="As in the pool file; holds until that changes it.", dynamic_typing=True
        )
        self._ours = True
        try:
            for name in self._shown - values.keys():
                self._node.undeclare_parameter(name)
            for name in values.keys() - self._shown:
                self._node.declare_parameter(name, values[name], about)
            self._shown = frozenset(values)
            stale = [n for n in values if self._node.get_parameter(n).value != values[n]]
            self._node.set_parameters([Parameter(name, value=values[name]) for name in stale])
        finally:
            self._ours = False

    def _on_set(self, parameters: Sequence[Any]) -> Any:
        from rcl_interfaces.msg import SetParametersResult

        given = {p.name: p.value for p in parameters if p.name in self._shown}
        reason = "" if self._ours or not given else self._judge(given)
        return SetParametersResult(successful=not reason, reason=reason)


def _new_node(name: str, context: Any) -> Any:
    import rclpy

    usual: dict[str, Any] = {"context": context, "use_global_arguments": False}
    try:
        return rclpy.create_node(name, enable_logger_service=True, **usual)
    except TypeError:  # ROS 2 Humble has no such service
        return rclpy.create_node(name, **usual)


def _diagnostics_publisher(node: Any) -> Any:
    """Return the publisher of `/diagnostics`, or None if its message type is not installed."""
    try:
        from diagnostic_msgs.msg import DiagnosticArray
    except ImportError as error:
        log.warning(
            "diagnostics_off reason=%r hint='install the package diagnostic_msgs "
            "(ros-diagnostic-msgs, or ros-DISTRO-diagnostic-msgs) and start the proxy again'",
            str(error),
        )
        return None
    return node.create_publisher(DiagnosticArray, TOPIC, 10)


OURS = "fogft"  # the parent of all our loggers
RECORDS_LIMIT = 1000
SAME_LIMIT = 10  # per second and kind: rclpy takes longer for one record than a request takes


class RosLog(logging.Handler):
    """A log handler that forwards records to a node's logger, and so to `/rosout`.

    Of records that differ only in their values, it forwards `SAME_LIMIT` a second and counts the
    rest. Changing that logger's level changes ours. `wake` causes `pass_on` to be called soon.
    """

    def __init__(self, logger: Any, wake: Callable[[], None]) -> None:
        super().__init__()
        self._logger = logger
        self._wake = wake
        self._waiting: deque[logging.LogRecord] = deque()
        self._dropped = 0
        self._second, self._same = 0, Counter[str]()  # how many of each kind in that second
        ours = logging.getLogger(OURS)
        level = ours.getEffectiveLevel() // 10 * 10  # both use the same numbers
        logger.set_level(max(logging.DEBUG, min(logging.CRITICAL, level)))
        self._level: int = int(logger.get_effective_level())
        ours.addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a record for `pass_on`."""
        if (second := int(record.created)) != self._second:
            self._second = second
            self._same.clear()
        self._same[record.msg] += 1
        if len(self._waiting) >= RECORDS_LIMIT or self._same[record.msg] > SAME_LIMIT:
            self._dropped += 1
            return
        self._waiting.append(record)
        self._wake()

    def pass_on(self) -> None:
        """Forward queued records, and follow the logger's level. The node's thread only."""
        while self._waiting:
            self._tell(self._waiting.popleft())
        if self._dropped:
            dropped, self._dropped = self._dropped, 0
            self._logger.warning(f"log_records_dropped count={dropped}")
        level = int(self._logger.get_effective_level())
        if level != self._level:
            self._level = level
            logging.getLogger(OURS).setLevel(level)
            log.warning("log_level_changed to=%s", logging.getLevelName(level))

    def _tell(self, record: logging.LogRecord) -> None:
        try:
            text = self.format(record).encode(errors="replace").decode()  # rclpy takes UTF-8
        except Exception:  # a message that does not match its arguments
            self.handleError(record)
            return
        # rclpy ties a line of code to one level, so each level has its own line.
        if record.levelno >= logging.CRITICAL:
            self._logger.fatal(text)
        elif record.levelno >= logging.ERROR:
            self._logger.error(text)
        elif record.levelno >= logging.WARNING:
            self._logger.warning(text)
        elif record.levelno >= logging.INFO:
            self._logger.info(text)
        else:
            self._logger.debug(text)

    def close(self) -> None:
        """Stop taking records. Idempotent."""
        logging.getLogger(OURS).removeHandler(self)
        super().close()
