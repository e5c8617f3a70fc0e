"""A fake RunPod: the part of its interface that SkyPilot uses; pods are VMs behind mapped ports.

Nobody reaches a pod but by a port of 10.66.0.1 that is mapped to one of its own. It sells what the
home's catalogue lists, and nothing on spot. At most LIMIT pods fit; one more is refused in RunPod's
words. POST /graphql is RunPod's; GET /pods is for tests.
"""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[2]))
from tests.sky.emulated_aws.http_answers import Answers  # noqa: E402

IMAGE = Path(os.environ["EMULATION"])
HIDDEN = [folder for folder in os.environ.get("HIDDEN", "").split(":") if folder]
PORT = 5568
LIMIT = 1
FULL = (
    "There are no longer any instances available with the requested specifications. "
    "Please refresh and try again."
)
KEY = "runpod-key"


class Pod:
    """One pod: a VM, and a relay for each of its TCP ports."""

    numbers = itertools.count(2)
    public_ports = itertools.count(31000)

    def __init__(self, said: str) -> None:
        number = next(self.numbers)
        self.id, self.name = f"pod{number:05d}", _field(said, "name")
        self.kind, self.zone = _field(said, "instanceId"), _field(said, "dataCenterId")
        self.address = f"10.66.200.{number}"
        script = base64.b64decode(_field(said, "dockerArgs").split("echo ")[1].split(" |")[0])
        (key,) = re.findall(r'echo "(ssh-\S+ [^"]+)"', script.decode())
        private = [int(port) for port in re.findall(r"(\d+)/tcp", _field(said, "ports"))]
        self.listeners = {port: self._map(port) for port in private}
        with (IMAGE / f"{self.id}.log").open("wb") as log:
            self.vm = subprocess.Popen(
                ["bash", HERE / "vm.sh", self.id, self.address, IMAGE, IMAGE / "host", "root",
                 key.strip(), ":", *HIDDEN],
                stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip

    def _map(self, private: int) -> socket.socket:
        listener = socket.create_server(("10.66.0.1", next(self.public_ports)))
        threading.Thread(target=self._relay, args=(listener, private), daemon=True).start()
        return listener

    def _relay(self, listener: socket.socket, private: int) -> None:
        with contextlib.suppress(OSError):  # it was closed
            while True:
                outer, _ = listener.accept()
                try:
                    inner = socket.create_connection((self.address, private), 5)
                except OSError:
                    outer.close()
                    continue
                inner.settimeout(None)
                for ends in ((outer, inner), (inner, outer)):
                    threading.Thread(target=_pump, args=ends, daemon=True).start()

    def end(self) -> None:
        for listener in self.listeners.values():
            listener.shutdown(socket.SHUT_RDWR)
            listener.close()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.vm.pid, signal.SIGKILL)
        self.vm.wait()
        subprocess.run(["ip", "netns", "del", self.id], check=False, capture_output=True)

    def shown(self) -> dict[str, Any]:
        mapped = [
            {"ip": "10.66.0.1", "isIpPublic": True, "privatePort": private,
             "publicPort": listener.getsockname()[1], "type": "tcp"}
            for private, listener in self.listeners.items()
        ]  # fmt: skip
        inner = {"ip": self.address, "isIpPublic": False, "privatePort": 1, "publicPort": 1}
        return {
            "id": self.id, "name": self.name, "desiredStatus": "RUNNING", "vcpuCount": 2,
            "dataCenterId": self.zone, "runtime": {"ports": [*mapped, inner]},
        }  # fmt: skip


PODS: dict[str, Pod] = {}


def _field(said: str, name: str) -> str:
    found = re.search(rf'\b{name}: "((?:[^"\\]|\\.)*)"', said)
    return found[1] if found else ""


def _pump(source: socket.socket, sink: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(65_536):
            sink.sendall(data)
    for end in (source, sink):
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


def answer(query: str) -> dict[str, Any]:
    """Return what RunPod answers to a query of SkyPilot's."""
    if "deployCpuPod" in query:
        if len(PODS) >= LIMIT:
            return {"errors": [{"message": FULL}], "data": None}
        pod = Pod(query)
        PODS[pod.id] = pod
        return {"data": {"deployCpuPod": {"id": pod.id}}}
    if "podTerminate" in query:
        PODS.pop(_field(query, "podId")).end()
        return {"data": {"podTerminate": None}}
    if "updateUserSettings" in query:
        return {"data": {"updateUserSettings": {"id": "user", "pubKey": ""}}}
    if "pubKey" in query:
        return {"data": {"myself": {"id": "user", "pubKey": "", "networkVolumes": []}}}
    if "podTemplates" in query:
        return {"data": {"myself": {"podTemplates": []}}}
    if "pods" in query:
        return {"data": {"myself": {"pods": [pod.shown() for pod in PODS.values()]}}}
    return {"errors": [{"message": f"not in the emulation: {query}"}]}


class Api(Answers, BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.answer([pod.shown() for pod in PODS.values()])

    def do_POST(self) -> None:
        said = json.loads(self.rfile.read(int(self.headers["content-length"])))
        known = self.headers["Authorization"] == f"Bearer {KEY}"
        self.answer(answer(said["query"]) if known else {}, 200 if known else 401)


def main() -> None:
    def stop(*_: Any) -> None:
        for pod in PODS.values():
            pod.end()
        os._exit(0)

    signal.signal(signal.SIGTERM, stop)
    ThreadingHTTPServer(("127.0.0.1", PORT), Api).serve_forever()


if __name__ == "__main__":
    main()
