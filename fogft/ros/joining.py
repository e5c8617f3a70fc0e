"""Join a ROS domain: a context, optionally with a DDS participant before any visible node.

A participant that is known already has its services found within milliseconds, a new one in half a
second. Owns: contexts. Not here: the node of a proxy (`node`).
"""

import logging
import time
from collections.abc import Callable
from typing import Any

from fogft.errors import RosError
from fogft.ros import spdp
from fogft.ros.shared_memory import break_dead_ports, make_private

log = logging.getLogger(__name__)

_SET_BACK_S = 0.5
_FORGOTTEN_AFTER_S = 15.0  # of the 20 s that Fast DDS waits for a sign of life, sent every 3 s
# A process that proxies must not leave files in ~/.ros/log; it has a log of its own, on standard
# error. What goes through rclpy's loggers goes to /rosout only, or each line would be there twice.
_ROS_ARGUMENTS = ["--ros-args", "--disable-external-lib-logs", "--disable-stdout-logs"]


def new_context(domain_id: int | None) -> Any:
    """Return a new rclpy context; its first node joins. Raises rclpy's errors, and ImportError."""
    import rclpy
    from rclpy.context import Context
    from rclpy.signals import SignalHandlerOptions

    context = Context()
    rclpy.init(
        args=_ROS_ARGUMENTS,
        context=context,
        domain_id=domain_id,
        signal_handler_options=SignalHandlerOptions.NO,
    )
    break_dead_ports(context.get_domain_id())
    return context


def bare_node(name: str, context: Any) -> Any:
    """Return a node without any publisher, service or parameter."""
    import rclpy
    from rclpy.parameter import Parameter

    node = rclpy.create_node(
        name,
        context=context,
        use_global_arguments=False,
        enable_rosout=False,
        start_parameter_services=False,
        parameter_overrides=[Parameter("start_type_description_service", value=False)],
    )
    make_private()
    return node


class Timers:
    """Keeps Fast DDS's timers going when the system clock is set back.

    Built for glibc before 2.30, as ROS's wheels are, Fast DDS waits by the system clock: set back
    by an hour, its timers stand still for an hour. It sends no sign of life, and others forget it
    after 20 s. A new entity wakes them.
    """

    def __init__(self) -> None:
        self._ahead_s = time.time() - time.monotonic()

    def look(self, node: Any) -> None:
        """Wake the timers of a node's participant if the clock was set back since the last look."""
        before, self._ahead_s = self._ahead_s, time.time() - time.monotonic()
        if before - self._ahead_s > _SET_BACK_S:
            from rcl_interfaces.msg import Log

            try:
                node.destroy_publisher(node.create_publisher(Log, "_fogft_clock_set", 1))
            except Exception:  # rclpy's
                log.exception("clock_set_back")


class Pauses:
    """Notices that this process was stopped for so long that others may have forgotten it.

    Fast DDS forgets those of whom it has not heard for 20 s, each side by itself. Afterwards one
    may go on as before with another that has forgotten it, and neither ever hears the other again.
    A new participant is found by all.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._at = clock()

    def was_long(self) -> bool:
        """Whether it was stopped since the last call. Call it every second or more often."""
        before, self._at = self._at, self._clock()
        paused_s = self._at - before
        if paused_s <= _FORGOTTEN_AFTER_S:
            return False
        log.warning("process_was_stopped seconds=%.0f", paused_s)
        return True


class EarlyJoin:
    """A participant that others discover before it offers anything.

    The participant comes with a context's first node. Its node offers nothing, and ROS's tools hide
    it if its name begins with an underscore. `introduction` is what introduces it: to end that soon
    would cost whole seconds.

    Raises RosError: ROS 2 is not usable here.
    """

    def __init__(self, name: str, domain_id: int | None) -> None:
        try:
            self.context = new_context(domain_id)
            self._node = bare_node(name, self.context)
        except Exception as error:  # ImportError, or rclpy's
            raise RosError(f"ROS 2 cannot be used here: {error}") from error
        self.introduction = spdp.Introduction(self.context.get_domain_id())
        self._timers = Timers()

    def look(self) -> None:
        """Keep the participant known to others. Call it every second or more often."""
        self._timers.look(self._node)

    def end_node(self) -> None:
        """End the hidden node: another node uses the participant, and is known to those that run.

        Not earlier: where an endpoint ends while others are still told of it, Fast DDS tells them
        nothing more for a second.
        """
        self._node.destroy_node()

    def close(self) -> None:
        """Leave the domain, if no node has taken over the context."""
        self.end_node()
        self.introduction.close()
        self.context.try_shutdown()
