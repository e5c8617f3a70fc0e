"""The transport's own round trip: a bare Zenoh `get` over mutual TLS, on one link.

    python -m tests.bench.floor FOLDER PORT     answers until its parent ends it

No ids, no deadlines, no probes, no ROS: what no proxy over Zenoh can go below.
"""

from __future__ import annotations

import ctypes
import json
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import zenoh
from zenoh import handlers

KEYS = {"flag": 16, "map": 8}  # key -> size of the answer, as the services' responses
_LIMIT_S = 5.0


def configuration(folder: Path, stem: str, **endpoints: list[str]) -> Any:
    """Return a Zenoh configuration with one explicit link, as a proxy's link has."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps("peer" if "listen" in endpoints else "client"))
    for direction in ("listen", "connect"):
        config.insert_json5(f"{direction}/endpoints", json.dumps(endpoints.get(direction, [])))
    for switch in ("scouting/multicast", "scouting/gossip", "transport/shared_memory"):
        config.insert_json5(f"{switch}/enabled", "false")
    pair = {
        f"{side}_{kind}": str(folder / f"{stem}.{suffix}")
        for side in ("listen", "connect")
        for kind, suffix in (("certificate", "crt"), ("private_key", "key"))
    }
    tls = {"root_ca_certificate": str(folder / "ca.crt"), "enable_mtls": True, **pair}
    config.insert_json5("transport/link/tls", json.dumps({**tls, "verify_name_on_connect": False}))
    return config


class Floor:
    """The asking end."""

    def __init__(self, folder: Path, port: int) -> None:
        config = configuration(folder, "robot", connect=[f"tls/127.0.0.1:{port}"])
        self._session = zenoh.open(config)

    def call(self, key: str, payload: bytes) -> float:
        """Return how long one round trip took, in seconds."""
        answered = threading.Event()
        on_reply = handlers.Callback(lambda _: answered.set(), None, indirect=False)
        began = time.perf_counter()
        self._session.get(
            f"bench/{key}",
            on_reply,
            payload=payload,
            timeout=_LIMIT_S,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        if not answered.wait(_LIMIT_S):
            raise TimeoutError("the bare round trip got no answer")
        return time.perf_counter() - began

    def close(self) -> None:
        """End the session."""
        self._session.close()


def serve(folder: Path, port: int) -> None:
    """Answer until the process is ended."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # die with the bench
    session = zenoh.open(configuration(folder, "replica", listen=[f"tls/127.0.0.1:{port}"]))
    kept = []
    for key, size in KEYS.items():
        answer = bytes(size)

        def reply(query: Any, answer: bytes = answer) -> None:
            query.reply(query.key_expr, answer)
            query.drop()

        on_query = handlers.Callback(reply, None, indirect=False)
        kept.append(session.declare_queryable(f"bench/{key}", on_query))
    print("ready", flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    serve(Path(sys.argv[1]), int(sys.argv[2]))
