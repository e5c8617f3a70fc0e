"""Join a ROS domain: a context, and where wanted a DDS participant before there is a node to see.

DDS takes up to three seconds until a new participant and those that run know of each other (Fast
DDS loses what it is answered in its first milliseconds, and hears it anew every three seconds). A
participant that is known already has its services found within milliseconds.

Owns: contexts. Not here: the node of a proxy (`node`).
"""

from __future__ import annotations

from typing import Any

from fogft.errors import RosError
from fogft.ros.shared_memory import make_private

# A process that proxies must not leave files in ~/.ros/log; it has a log of its own, on standard
# error. What goes through rclpy's loggers goes to /rosout only, or each line would be there twice.
_ROS_ARGUMENTS = ["--ros-args", "--disable-external-lib-logs", "--disable-stdout-logs"]


def new_context(domain_id: int | None) -> Any:
    """Return a context of its own. Raises what rclpy raises, and ImportError."""
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
    return context


def bare_node(name: str, context: Any) -> Any:
    """Return a node with no publisher, service or parameter of its own."""
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


class EarlyJoin:
    """A participant that others get to know before it offers anything.

    The participant comes with a context's first node. Its node is hidden from ROS's tools and
    offers nothing; it ends once there is another one.

    Args:
        name: Of the node; ROS's tools hide what begins with an underscore.
        domain_id: The ROS domain; None for ``ROS_DOMAIN_ID``, else 0.

    Raises:
        RosError: ROS 2 is not usable here.
    """

    def __init__(self, name: str, domain_id: int | None) -> None:
        try:
            self.context = new_context(domain_id)
            self._node = bare_node(name, self.context)
        except Exception as error:  # ImportError, or rclpy's
            raise RosError(f"ROS 2 cannot be used here: {error}") from error

    def done(self) -> None:
        """End the hidden node: another one holds the participant now."""
        self._node.destroy_node()

    def close(self) -> None:
        """Leave the domain; nobody has taken the context over."""
        self._node.destroy_node()
        self.context.try_shutdown()
