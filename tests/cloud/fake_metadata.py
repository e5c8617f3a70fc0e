"""A metadata server on loopback that answers as AWS, GCP or Azure does, headers included."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


class FakeMetadata:
    """What the cloud says of this machine. Change the attributes while it runs."""

    def __init__(self, cloud: str) -> None:
        self.cloud = cloud
        self.action: dict[str, str] | None = None
        self.rebalance: dict[str, str] | None = None
        self.preempted = "FALSE"
        self.events: list[dict[str, Any]] = []
        self.token = "token-1"
        self.status: int | None = None
        self.asked: list[str] = []
        self.waiting = threading.Condition()
        self.address = ""

    def saw(self, path: str) -> None:
        with self.waiting:
            self.asked.append(path)
            self.waiting.notify_all()

    def wait_for_questions(self, count: int) -> None:
        """Wait until so many more questions have come."""
        with self.waiting:
            wanted = len(self.asked) + count
            assert self.waiting.wait_for(lambda: len(self.asked) >= wanted, timeout=30)

    def reply(self, method: str, path: str, headers: Any) -> tuple[int, str, dict[str, str]]:
        if self.status is not None:
            return self.status, "", {}
        if self.cloud == "aws":
            return (*self._aws(method, path, headers), {})
        if self.cloud == "gcp":
            if headers.get("Metadata-Flavor") != "Google":
                return 403, "", {}
            found = {"/computeMetadata/v1/": "instance/", "/computeMetadata/v1/instance/preempted":
                     self.preempted}.get(path)  # fmt: skip
            return (200 if found else 404), found or "", {"Metadata-Flavor": "Google"}
        if headers.get("Metadata") != "true":
            return 400, "", {}
        if path.startswith("/metadata/instance/compute/name"):
            return 200, "vm-7", {}
        if path.startswith("/metadata/scheduledevents"):
            return 200, json.dumps({"DocumentIncarnation": 1, "Events": self.events}), {}
        return 404, "", {}

    def _aws(self, method: str, path: str, headers: Any) -> tuple[int, str]:
        if path == "/latest/api/token":
            ttl = headers.get("X-aws-ec2-metadata-token-ttl-seconds")
            return (200, self.token) if method == "PUT" and ttl else (400, "")
        if headers.get("X-aws-ec2-metadata-token") != self.token:
            return 401, ""
        found = {
            "/latest/meta-data/spot/instance-action": self.action,
            "/latest/meta-data/events/recommendations/rebalance": self.rebalance,
        }.get(path)
        return (200, json.dumps(found)) if found else (404, "")


@contextmanager
def serving(cloud: str) -> Iterator[FakeMetadata]:
    fake = FakeMetadata(cloud)

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None: ...

        def do_GET(self) -> None:
            status, body, headers = fake.reply(self.command, self.path, self.headers)
            data = body.encode()
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.send_header("content-length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)
            fake.saw(self.path)

        do_PUT = do_GET  # noqa: N815

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    fake.address = f"127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield fake
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
