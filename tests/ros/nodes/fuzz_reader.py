"""Feed noise to the middleware's reader of serialised messages. Run as a process of its own.

Prints how many inputs were read and how many refused; a crash ends the process instead.
"""

from __future__ import annotations

import random
import sys
from typing import Any

from fogft.errors import RosError
from fogft.ros.serialised import CMessage
from fogft.ros.types import load_service_type

HEADERS = [b"\0\1\0\0", b"\0\0\0\0", b"\0\3\0\0", b"\0\7\0\0", b"\0\x0b\0\0", b"\xff\xff\xff\xff"]
LENGTHS = [b"\xff\xff\xff\xff", b"\0\0\0\x80", b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\1\0\0\0"]


def corrupted(good: bytes, chance: random.Random) -> bytes:
    """Return noise, or a good message with bytes changed, cut off, added or a length forged."""
    kind = chance.randrange(5)
    if kind == 0:
        return chance.choice(HEADERS) + chance.randbytes(chance.randrange(300))
    noisy = bytearray(good)
    if kind == 1:
        return bytes(noisy[: chance.randrange(len(noisy) + 1)])
    for _ in range(chance.randrange(1, 6)):
        at = chance.randrange(4, len(noisy)) if len(noisy) > 4 else 0
        if kind == 2:
            noisy[at] = chance.randrange(256)
        elif kind == 3:
            at -= at % 4
            noisy[at : at + 4] = chance.choice(LENGTHS)
        else:
            noisy[at:at] = chance.randbytes(chance.randrange(1, 9))
    noisy[:4] = chance.choice([bytes(noisy[:4]), chance.choice(HEADERS)])
    return bytes(noisy)


def good_messages(message_type: Any) -> list[bytes]:
    from rclpy.serialization import serialize_message

    return [bytes(serialize_message(message_type()))]


def main(seed: int, rounds: int, names: list[str]) -> None:
    chance = random.Random(seed)
    read = refused = 0
    for name in names:
        service_type = load_service_type(name)
        for message_type in (service_type.Request, service_type.Response):
            message = CMessage(message_type)
            goods = good_messages(message_type)
            for _ in range(rounds):
                try:
                    message.read(corrupted(chance.choice(goods), chance))
                    goods = [*goods[-20:], message.write()]
                    read += 1
                except RosError:
                    refused += 1
            message.close()
    print(read, refused)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])
