"""Two stateful services: a counter (SetBool) and a key-value store (LoadMap), by both helpers.

    python stateful_node.py [RESTORE_S [FILE]]

``SetBool(data=True)`` adds one; the sum is the answer's `message`. LoadMap's `map_url` is
``put KEY VALUE`` or ``get KEY``; the old value is the answer's `frame_id`. With RESTORE_S each
restore of the counter takes so long, and FILE is made when it begins.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import rclpy
from nav_msgs.srv import LoadMap
from rclpy.node import Node
from std_srvs.srv import SetBool

from fogft.ros.stateful import AttributeState, StateServices


class Stateful(Node):
    def __init__(self) -> None:
        super().__init__("stateful")
        self.total = 0
        self.values: dict[str, int] = {}
        self.create_service(SetBool, "/count", self.count)
        self.create_service(LoadMap, "/store", self.store)
        self.count_state = AttributeState(self, "/count", self, "total")
        self.store_state = StateServices(self, "/store", self.snapshot, self.restore)

    def count(self, request, response):
        self.total += request.data
        response.success, response.message = True, str(self.total)
        return response

    def store(self, request, response):
        kind, key, *value = request.map_url.split()
        response.map.header.frame_id = str(self.values.get(key, -1))
        if kind == "put":
            self.values[key] = int(value[0])
        return response

    def snapshot(self) -> bytes:
        return json.dumps(self.values, sort_keys=True).encode()

    def restore(self, state: bytes) -> None:
        if len(sys.argv) > 2:
            Path(sys.argv[2]).touch()
        time.sleep(float(sys.argv[1]) if len(sys.argv) > 1 else 0.0)
        self.values = json.loads(state)


rclpy.init()
rclpy.spin(Stateful())
