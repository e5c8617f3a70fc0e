"""A service type, and a service of it, on `pyzeros`: nodes of `rmw_zenoh` with no ROS installed.

The type is nobody's but this file's: no package of it exists, so a proxy that answers for it has
loaded none. `pyzeros` compiles its codecs with a C compiler at first use, which takes minutes on
a small machine; the one it needs here, of 33 bytes, is put in by hand. ``FOGFT_PYZEROS_CODECS=1``
leaves its own.

As a program: ``echo_over_zenoh.py NAME DELAY_S`` answers "NAME: what was asked".
"""

from __future__ import annotations

import asyncio
import hashlib
import os
import struct
import sys
from dataclasses import dataclass, field
from typing import Any

import pyzeros
import pyzeros.service_client
import pyzeros.service_server
import zenoh
from pyzeros.qos import QosProfile

from fogft.rmw_zenoh.node import settings_from

_HEADER = b"\x00\x01\x00\x00"


@dataclass
class Text:
    """A message with one text in it."""

    text: str = ""

    def serialize(self) -> bytes:
        """Return it as CDR."""
        raw = self.text.encode() + b"\0"
        return _HEADER + struct.pack("<I", len(raw)) + raw

    @classmethod
    def deserialize(cls, payload: bytes) -> Text:
        """Read it from CDR."""
        (size,) = struct.unpack_from("<I", payload, 4)
        return cls(bytes(payload[8 : 8 + size - 1]).decode())


class Echo:
    """``fogft_words/srv/Echo``: a text in, a text out."""

    Request = Text
    Response = Text

    @classmethod
    def get_type_name(cls) -> str:
        """Return its name."""
        return "fogft_words/srv/Echo"

    @classmethod
    def hash_rihs01(cls) -> str:
        """Return its hash."""
        return "RIHS01_" + hashlib.sha256(cls.get_type_name().encode()).hexdigest()


@dataclass
class _Attachment:
    sequence_number: int = 0
    source_timestamp: int = 0
    source_gid: Any = field(default_factory=lambda: bytes(16))

    def serialize(self) -> bytes:
        numbers = struct.pack("<qqB", int(self.sequence_number), int(self.source_timestamp), 16)
        return _HEADER + numbers + bytes(self.source_gid)

    @classmethod
    def deserialize(cls, payload: bytes) -> _Attachment:
        sequence, stamp, size = struct.unpack_from("<qqB", payload, 4)
        assert size == 16
        assert len(payload) == 4 + 33
        return cls(sequence, stamp, payload[21:])


if not os.environ.get("FOGFT_PYZEROS_CODECS"):
    pyzeros.service_client.Attachment = _Attachment  # type: ignore[misc, assignment]
    pyzeros.service_server.Attachment = _Attachment  # type: ignore[misc, assignment]


def session() -> zenoh.Session:
    """Open a session that is configured as those of `rmw_zenoh`."""
    return zenoh.open(settings_from(os.environ))


async def _serve(name: str, delay_s: float) -> None:
    async def answer(responder: Any) -> None:
        await asyncio.sleep(delay_s)
        responder.send(Text(f"{name}: {responder.request.text}"))

    with pyzeros.auto_context(node=f"echo_{name}", zenoh_session=session()):
        server = pyzeros.Server(
            Echo, "/words/echo", qos_profile=QosProfile(history="keep_all", depth=0)
        )
        under_way = set()
        async for responder in server.listen_reliable(queue_size=0):
            task = asyncio.create_task(answer(responder))
            under_way.add(task)
            task.add_done_callback(under_way.discard)


if __name__ == "__main__":
    asyncio.run(_serve(sys.argv[1], float(sys.argv[2])))
