"""A registry of container images that begins with one, made of a folder.

usage: registry.py FOLDER ADDRESS PORT [NAME=VALUE...]
    FOLDER      the image's root
    NAME=VALUE  environment of whatever runs in it

The image is `ADDRESS:PORT/ros:1`. Its one layer is a plain tar.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import subprocess
import sys
import urllib.parse
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


class Images:
    """What a registry answers with: digests, the file of each, and tags."""

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
        kept = self._keep(beside / "container.manifest", manifest)
        self.tags = {"/v2/ros/manifests/1": str(kept["digest"])}
        self.beside = beside

    def _keep(self, path: Path, value: Any) -> dict[str, Any]:
        path.write_text(json.dumps(value))
        name = digest(read(path))
        self.blobs[name] = path
        return {"digest": name, "size": path.stat().st_size}


def serve(images: Images, address: str, port: int) -> None:
    uploads = itertools.count()

    class Registry(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_HEAD(self) -> None:
            self._answer(body=False)

        def do_GET(self) -> None:
            self._answer(body=True)

        def do_POST(self) -> None:
            self._said(202, location=f"/v2/upload/{next(uploads)}")

        def do_PATCH(self) -> None:
            with self._upload().open("ab") as file:
                file.writelines(self._body())
                last = max(0, file.tell() - 1)
            self._said(202, location=self.path, range=f"0-{last}")

        def do_PUT(self) -> None:
            if "/manifests/" not in self.path:
                query = urllib.parse.parse_qs(urllib.parse.urlparse(self.path).query)
                images.blobs[query["digest"][0]] = self._upload()
                return self._said(201)
            path = images.beside / f"manifest.{next(uploads)}"
            path.write_bytes(b"".join(self._body()))
            name = digest(read(path))
            images.blobs[name] = path
            images.tags[self.path] = name
            return self._said(201, **{"docker-content-digest": name})

        def _upload(self) -> Path:
            number = urllib.parse.urlparse(self.path).path.rsplit("/", 1)[1]
            return images.beside / f"upload.{number}"

        def _body(self) -> Iterator[bytes]:
            if self.headers.get("transfer-encoding") != "chunked":
                yield self.rfile.read(int(self.headers.get("content-length") or 0))
                return
            while size := int(self.rfile.readline(), 16):
                yield self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()

        def _said(self, status: int, **headers: str) -> None:
            self.send_response(status)
            self.send_header("content-length", "0")
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()

        def _answer(self, *, body: bool) -> None:
            name = images.tags.get(self.path) or self.path.rsplit("/", 1)[1]
            kind = MANIFEST if "/manifests/" in self.path else "application/octet-stream"
            found = images.blobs.get(name)
            if found is None:
                return self._said(200 if self.path == "/v2/" else 404)
            self.send_response(200)
            self.send_header("content-type", kind)
            self.send_header("content-length", str(found.stat().st_size))
            self.send_header("docker-content-digest", name)
            self.end_headers()
            for chunk in read(found) if body else ():
                self.wfile.write(chunk)
            return None

    ThreadingHTTPServer((address, port), Registry).serve_forever()


if __name__ == "__main__":
    serve(Images(Path(sys.argv[1]), sys.argv[4:]), sys.argv[2], int(sys.argv[3]))
