"""Join a ROS domain: a context, optionally with a DDS participant before any visible node.

Others discover the services of a participant that they know within milliseconds, those of a new one
in half a second. Owns: contexts. Not here: the node of a proxy (`node`).
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
_FORGOTTEN_AFTER_S = 15.0  # of the 20 s lease of Fast DDS, renewed every 3 s
# A proxy must not leave files in ~/.ros/log; it writes its own log to standard error. rclpy's
# loggers write to /rosout only, or each line would appear twice.
_ROS_ARGUMENTS = ["--ros-args", "--disable-external-lib-logs", "--disable-stdout-logs"]


def new_context(domain_id: int | None) -> Any:
    """Return a new rclpy context; its first node joins. Raises rclpy's errors or ImportError."""
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

    If built for glibc before 2.30, as in ROS's wheels, Fast DDS waits by the system clock: when the
    clock is set back by an hour, its timers stand still for an hour. It does not renew its lease,
    and others forget it after 20 s. Creating an entity wakes the timers.
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
    """Detects that this process was stopped for so long that others may have forgotten it.

    Fast DDS forgets a participant that it has not heard from for 20 s, each side on its own. If
    only one of two sides has forgotten the other, neither ever hears the other again. All discover
    a new participant.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._at = clock()

    def was_long(self) -> bool:
        """Whether it was stopped since the last call. Call it at least once a second."""
        before, self._at = self._at, self._clock()
        paused_s = self._at - before
        if paused_s <= _FORGOTTEN_AFTER_S:
            return False
        log.warning("process_was_stopped seconds=%.0f", paused_s)
        return True


class EarlyJoin:
    """A participant that others discover before it offers anything.

    A context's first node creates the participant. That node offers nothing, and ROS tools hide it
    if its name begins with an underscore. `introduction` introduces it to others: ending that early
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
        """Keep the participant discoverable. Call it at least once a second."""
        self._timers.look(self._node)

    def end_node(self) -> None:
        """End the hidden node, once others know the node that now uses the participant.

        Not earlier: if an endpoint ends while others are still being told of it, Fast DDS tells
        them nothing more for a second.
        """
        self._node.destroy_node()

    def close(self) -> None:
        """Leave the domain, if no node has taken over the context."""
        self.end_node()
        self.introduction.close()
        self.context.try_shutdown()
