"""Make a Python node's service stateful in a few lines. This file needs nothing else of fogft.

    from fogft.ros.stateful import AttributeState

    class Counter(Node):
        def __init__(self):
            super().__init__("counter")
            self.total = 0
            self.create_service(Add, "/count", self.add)
            self.state = AttributeState(self, "/count", self, "total")

and in the pool file ``state: {snapshot: /count/get_state, restore: /count/set_state}``.
"""

import array
import json
from collections.abc import Callable
from typing import Any


class StateServices:
    """Offers ``SERVICE/get_state`` and ``SERVICE/set_state`` for a state given as bytes.

    Args:
        node: The rclpy node that offers the service of that name.
        snapshot: Returns the whole state. Equal states should give equal bytes.
        restore: Replaces the current state with a whole new one. An exception is reported to
            the proxy, which tries again.
    """

    def __init__(
        self,
        node: Any,
        service: str,
        snapshot: Callable[[], bytes],
        restore: Callable[[bytes], None],
    ) -> None:
        from nav_msgs.srv import GetMap, SetMap

        self._snapshot, self._restore = snapshot, restore
        self._log = node.get_logger()
        name = service.rstrip("/")
        self.services = (
            node.create_service(GetMap, f"{name}/get_state", self._get),
            node.create_service(SetMap, f"{name}/set_state", self._set),
        )

    def _get(self, _: Any, response: Any) -> Any:
        response.map.data = array.array("b", self._snapshot())
        return response

    def _set(self, request: Any, response: Any) -> Any:
        try:
            self._restore(request.map.data.tobytes())
            response.success = True
        except Exception as error:
            self._log.error(f"the state cannot be restored: {error!r}")
            response.success = False
        return response


class AttributeState(StateServices):
    """`StateServices` for attributes of an object (its owner), as JSON.

    Their values may be numbers, text, and lists and dictionaries of these.
    """

    def __init__(self, node: Any, service: str, owner: Any, *names: str) -> None:
        def snapshot() -> bytes:
            values = {name: getattr(owner, name) for name in names}
            return json.dumps(values, sort_keys=True).encode()

        def restore(state: bytes) -> None:
            values = json.loads(state)
            for name in names:
                setattr(owner, name, values[name])

        super().__init__(node, service, snapshot, restore)
