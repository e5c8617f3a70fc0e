"""Places to inspect, each given out once: the state of the service, kept in etcd.

etcd is asked by its HTTP gateway, so Python's standard library is enough.
"""

from __future__ import annotations

import base64
import itertools
import json
import time
import urllib.request
from collections.abc import Sequence
from typing import Any

GIVEN_OUT = "inspection/given_out"
ANSWER = "inspection/answer/"
# How long an answer is kept for a request that comes again: longer than one can be on its way.
KEPT_S = 3600


class Places:
    """The places of one cluster of etcd. Calls wait until a member of it answers.

    Args:
        urls: Its members, such as ``http://10.0.0.5:2379``.
    """

    def __init__(self, urls: Sequence[str]) -> None:
        self._urls = itertools.cycle(urls)
        self._url = next(self._urls)

    def take(self, request_id: str) -> int:
        """Give out the next place; for the id of an earlier request, that request's place again.

        Both keys are written in one transaction, and only if neither has changed since it was
        read: of two replicas with the same request, or with two requests, one reads once more.
        """
        answer = ANSWER + request_id
        while True:
            known, given_out = self._read(answer, GIVEN_OUT)
            if known is not None:
                return int(known)
            place = int(given_out or "0")
            lease = self._call("lease/grant", {"TTL": KEPT_S})["ID"]
            written = self._call(
                "kv/txn",
                {
                    "compare": [_is_still(answer, None), _is_still(GIVEN_OUT, given_out)],
                    "success": [
                        {"request_put": _pair(GIVEN_OUT, str(place + 1))},
                        {"request_put": {**_pair(answer, str(place)), "lease": lease}},
                    ],
                },
            )
            if written.get("succeeded"):
                return place

    def given_out(self) -> int:
        """Return how many places were given out."""
        return int(self._read(GIVEN_OUT)[0] or "0")

    def _read(self, *keys: str) -> list[str | None]:
        """Return the values of keys, all as they were at one moment; None for no such key."""
        ranges = [{"request_range": {"key": _base64(key)}} for key in keys]
        found = self._call("kv/txn", {"success": ranges})["responses"]
        pairs = [each["response_range"].get("kvs") for each in found]
        return [base64.b64decode(kvs[0]["value"]).decode() if kvs else None for kvs in pairs]

    def _call(self, what: str, content: dict[str, Any]) -> dict[str, Any]:
        """Call etcd until it answers. What is written twice by that is written once: see `take`."""
        body, headers = json.dumps(content).encode(), {"Content-Type": "application/json"}
        while True:
            request = urllib.request.Request(f"{self._url}/v3/{what}", body, headers)
            try:
                with urllib.request.urlopen(request, timeout=2) as reply:
                    return dict(json.load(reply))
            except (OSError, ValueError) as error:
                print(f"no answer from {self._url}: {error}", flush=True)
                self._url = next(self._urls)
                time.sleep(0.2)


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


def _pair(key: str, value: str) -> dict[str, Any]:
    return {"key": _base64(key), "value": _base64(value)}


def _is_still(key: str, value: str | None) -> dict[str, Any]:
    """Return the condition that a key has this value, or is not there."""
    if value is None:
        return {"key": _base64(key), "target": "CREATE", "create_revision": "0"}
    return {**_pair(key, value), "target": "VALUE"}
