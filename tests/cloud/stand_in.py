"""A server proxy's stand-in: listens where it is told to, and echoes. Told by `replica.yaml`.

The file is JSON here: ``exit`` (end at once with that status), ``spawn`` (shell commands to
start first, each in a session of its own), ``deaf`` (echo nothing).
"""

from __future__ import annotations

import argparse
import json
import os
import socketserver
import subprocess
import sys
from pathlib import Path

parser = argparse.ArgumentParser()
for option in ("--config", "--listen", "--domain-id", "--workdir", "--notice-file"):
    parser.add_argument(option, required=True)
given = parser.parse_args()
config = json.loads(Path(given.config).read_text() or "{}")
folder = Path(given.config).parent
(folder / "given.json").write_text(json.dumps({**vars(given), "environ": dict(os.environ)}))
print("stand-in begins", flush=True)
for command in config.get("spawn", ()):
    subprocess.Popen(["bash", "-c", command], start_new_session=True)
if "exit" in config:
    print("stand-in cannot go on", flush=True)
    sys.exit(config["exit"])


class Echo(socketserver.BaseRequestHandler):
    def handle(self) -> None:
        while data := self.request.recv(1 << 16):
            if not config.get("deaf"):
                self.request.sendall(data)


class Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True


host, port = given.listen.split(":")
with Server((host, int(port)), Echo) as server:
    server.serve_forever()
