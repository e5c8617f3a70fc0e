"""Images as a camera sends them, 30 a second of 0.92 MB: how old they are when a node has them.

A plain rclpy node publishes them on the robot, and one at a replica takes them; beside that, in
turns, the same two nodes in one domain. Each message carries when it was sent; all clocks are one
machine's. On a machine that is busy, what is measured is how long each hop waits for a processor:
``chrt -r 5 scripts/bench --only images`` leaves that out.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from fogft.model.topic import Origin, TopicSpec
from tests.bench import machine
from tests.bench.rig import Rig
from tests.estimates import median, percentile
from tests.fakes.waiting import wait_for

IMAGE = "sensor_msgs/msg/Image"
NAME = "/bench_image"
TOPIC = TopicSpec(NAME, IMAGE, Origin.ROBOT, depth=10)
_WIDTH, _HEIGHT, _CHANNELS = 640, 480, 3
_EVERY_S = 1 / 30
_TURN_S, _WARM_UP_S = 5.0, 2.0


def images(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Measure the age of images directly and through one replica, in turns, in one run."""
    turns = 2 if quick else 12
    rig = Rig(folder, 1, topics=(TOPIC,))
    with (folder / "nodes.log").open("wb") as log:
        hearing = {"direct": rig.bare_domain, "proxied": rig.domains[0]}
        speaking = {"direct": rig.bare_domain, "proxied": rig.robot_domain}
        readers = {way: _start("hear", domain, log) for way, domain in hearing.items()}
        try:
            with rig:
                writers = {way: _start("say", domain, log) for way, domain in speaking.items()}
                for process in (*writers.values(), *readers.values()):
                    assert process.stdout is not None
                    process.stdout.readline()
                proxies = rig.proxy.pid, rig.replicas[0].process.pid
                sent, used_s = dict.fromkeys(writers, 0), dict.fromkeys(writers, 0.0)
                for _ in range(turns):
                    for way, writer in writers.items():
                        used_s[way] -= sum(map(machine.cpu_s, proxies))
                        assert writer.stdin is not None
                        assert writer.stdout is not None
                        writer.stdin.write(b"\n")
                        writer.stdin.flush()
                        sent[way] += int(writer.stdout.readline())
                        used_s[way] += sum(map(machine.cpu_s, proxies))
                # While images pass directly, the proxies cost what they do when idle.
                whole = used_s["proxied"] - used_s["direct"]
                counted = _TURN_S / (_TURN_S + _WARM_UP_S)
                rows = [_row(way, reader, sent[way]) for way, reader in readers.items()]
                cpu_ms = {"direct": 0.0, "proxied": whole * counted * 1000 / sent["proxied"]}
                return [{**row, "both_proxies_cpu_ms": cpu_ms[row["way"]]} for row in rows]
        finally:
            rig.close()
            for process in (*readers.values(), *(locals().get("writers") or {}).values()):
                process.kill()
                process.wait()


def _row(way: str, reader: subprocess.Popen[bytes], sent: int) -> dict[str, Any]:
    assert reader.stdin is not None
    ages_ms = json.loads(reader.communicate(b"\n")[0])
    return {
        "way": way,
        "sent": sent,
        "taken": len(ages_ms),
        "p50_ms": median(ages_ms),
        "p99_ms": percentile(ages_ms, 99),
        "longest_ms": max(ages_ms),
    }


def _start(role: str, domain: int, log: Any) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "tests.bench.images", role, str(domain)]
    piped = subprocess.PIPE
    return subprocess.Popen(command, stdin=piped, stdout=piped, stderr=log)


def _say(node: Any) -> None:
    """Publish for a turn with each line of stdin; print how many counted."""
    from sensor_msgs.msg import Image

    publisher = node.create_publisher(Image, NAME, 10)
    wait_for(publisher.get_subscription_count, 60.0)
    size = _WIDTH * _HEIGHT * _CHANNELS
    message = Image(width=_WIDTH, height=_HEIGHT, encoding="rgb8", step=_WIDTH * _CHANNELS)
    message.data = os.urandom(size)
    print("ready", flush=True)
    for _ in sys.stdin:
        began = due = time.monotonic()
        counted = 0
        while due < began + _WARM_UP_S + _TURN_S:
            time.sleep(max(due - time.monotonic(), 0))
            counts = due >= began + _WARM_UP_S
            counted += counts
            message.header.frame_id = "counts" if counts else ""
            message.header.stamp.sec, ns = divmod(time.monotonic_ns(), 1_000_000_000)
            message.header.stamp.nanosec = ns
            publisher.publish(message)
            due += _EVERY_S
        time.sleep(1.0)
        print(counted, flush=True)


def _hear(node: Any) -> None:
    """Take what is published; when stdin has a line, print the ages of what counts."""
    import rclpy
    from sensor_msgs.msg import Image

    ages_ms: list[float] = []

    def take(message: Any) -> None:
        now = time.monotonic_ns()
        if message.header.frame_id:
            sent = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            ages_ms.append((now - sent) / 1e6)

    node.create_subscription(Image, NAME, take, 10)
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    print("ready", flush=True)
    sys.stdin.readline()
    print(json.dumps(ages_ms), flush=True)
    os._exit(0)


if __name__ == "__main__":
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    from fogft.ros import environment

    environment.prepare(os.environ)
    import rclpy

    rclpy.init(domain_id=int(sys.argv[2]))
    {"say": _say, "hear": _hear}[sys.argv[1]](rclpy.create_node(f"bench_{sys.argv[1]}"))
