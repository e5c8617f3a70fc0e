"""A registry of container images that has one, made of a folder: `docker pull` and no more.

usage: registry.py FOLDER ADDRESS PORT [NAME=VALUE...]
    FOLDER      the image's root
    NAME=VALUE  environment of whatever runs in it

The image is `ADDRESS:PORT/ros:1`. Its one layer is a plain tar.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

DOCKER = "application/vnd.docker."
MANIFEST = f"{DOCKER}distribution.manifest.v2+json"
CHUNK = 1 << 20
PATH = "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


def digest(chunks: Iterator[bytes]) -> str:
    found = hashlib.sha256()
    for chunk in chunks:
        found.update(chunk)
    return f"sha256:{found.hexdigest()}"


def read(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            yield chunk


class Image:
    """What a registry answers with: each digest and the file that has it."""

    def __init__(self, folder: Path, environ: Sequence[str]) -> None:
        beside = folder.parent
        layer = beside / "container.tar"
        subprocess.run(["tar", "-C", folder, "--numeric-owner", "-cf", layer, "."], check=True)
        layer_digest = digest(read(layer))
        config = {
            "architecture": "amd64",
            "os": "linux",
            "config": {"Env": [PATH, *environ]},
            "rootfs": {"type": "layers", "diff_ids": [layer_digest]},
        }
        self.blobs = {layer_digest: layer}
        kept = self._keep(beside / "container.config", config)
        manifest = {
            "schemaVersion": 2,
            "mediaType": MANIFEST,
            "config": {"mediaType": f"{DOCKER}container.image.v1+json", **kept},
            "layers": [
                {
                    "mediaType": f"{DOCKER}image.rootfs.diff.tar.gzip",
                    "digest": layer_digest,
                    "size": layer.stat().st_size,
                }
            ],
        }
        self.manifest = str(self._keep(beside / "container.manifest", manifest)["digest"])

    def _keep(self, path: Path, value: Any) -> dict[str, Any]:
        path.write_text(json.dumps(value))
        name = digest(read(path))
        self.blobs[name] = path
        return {"digest": name, "size": path.stat().st_size}


def serve(image: Image, address: str, port: int) -> None:
    class Registry(BaseHTTPRequestHandler):
        def do_HEAD(self) -> None:
            self._answer(body=False)

        def do_GET(self) -> None:
            self._answer(body=True)

        def _answer(self, *, body: bool) -> None:
            name = self.path.rsplit("/", 1)[1]
            kind = MANIFEST if "/manifests/" in self.path else "application/octet-stream"
            found = image.blobs.get(image.manifest if name == "1" else name)
            if found is None:
                self.send_response(200 if self.path == "/v2/" else 404)
                self.send_header("content-length", "0")
                self.end_headers()
                return
            self.send_response(200)
            self.send_header("content-type", kind)
            self.send_header("content-length", str(found.stat().st_size))
            self.send_header("docker-content-digest", image.manifest if name == "1" else name)
            self.end_headers()
            for chunk in read(found) if body else ():
                self.wfile.write(chunk)

    ThreadingHTTPServer((address, port), Registry).serve_forever()


if __name__ == "__main__":
    serve(Image(Path(sys.argv[1]), sys.argv[4:]), sys.argv[2], int(sys.argv[3]))
