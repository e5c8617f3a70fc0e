"""Throw damaged bytes at everything that reads records: ``python -m tests.records.fuzz_records``.

Good inputs are cut, spliced, flipped and repeated at random. A reader may refuse with
`RecordError`; anything else, or a record set that changed, ends the run and names the seed.
`--cases 1000000` takes a few minutes; the tests run a short one.
"""

from __future__ import annotations

import argparse
import json
import random
from collections import Counter
from collections.abc import Callable, Sequence

from fogft.records import frames
from fogft.records.record import RecordError, SignedRecord, from_plain, read_json, to_plain
from fogft.records.record_set import RecordSet, Verdict
from fogft.records.roster import SlotState
from tests.records import record_worlds as world

_TOKENS = [b"null", b"true", b"-1", b"1e999", b"NaN", b'""', b"[]", b"{}", b'"v":3', b"\\ud800",
           b"9" * 25, b"\x00", b"\xff", b",", b"}", b"]", b"[" * 50, b'{"a":' * 50]  # fmt: skip


def seeds() -> list[bytes]:
    """Return good inputs: bodies, messages, and whole streams."""
    records = [
        world.admission(3, 4, world.member(0, 1, "10.0.0.1:7447"), world.member(1, 2)),
        world.slot(0, 1, 2, SlotState("10.0.0.1:1", "10.0.0.2:2", True, ("/a", "/b"), False)),
        world.revocation(1, f"robot.eve.1.{world.UID}"),
    ]
    digest = {("slot", "0"): (1, 2), ("admission", ""): (3, 4)}
    messages = [
        frames.challenge(bytes(32), "10.0.0.1"), frames.greeting(b"c" * 500, b"s" * 70),
        frames.have(digest), frames.ping(), *frames.records(records),
    ]  # fmt: skip
    plain = [json.dumps(to_plain(one)).encode() for one in records]
    return [*(one.body for one in records), *plain, *messages, b"".join(messages)]


def damaged(rng: random.Random, good: Sequence[bytes]) -> bytes:
    """Return one of them with a few things done to it."""
    data = bytearray(rng.choice(good))
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(data) + 1)
        what = rng.randrange(5)
        if what == 0:
            del data[at : at + rng.randint(1, 40)]
        elif what == 1 and data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
        elif what == 2:
            data[at:at] = rng.choice(_TOKENS)
        elif what == 3:
            other = rng.choice(good)
            start = rng.randrange(len(other))
            data[at:at] = other[start : start + rng.randint(1, 60)]
        else:
            end = at + rng.randint(1, 30)
            data[at:end] = data[at:end] * 2
    return bytes(data)


def run(cases: int, seed: int) -> Counter[str]:
    """Return how often each reader read and refused.

    Raises:
        AssertionError: A record set changed.
    """
    rng, good, outcomes = random.Random(seed), seeds(), Counter[str]()
    held = RecordSet(world.UID, world.verify)
    held.offer(world.slot(0, 1, 2))
    before = held.digest()

    def offer(data: bytes) -> None:
        verdict = held.offer(SignedRecord(data, b"replica|x|1", b"unsigned"))
        if verdict is not Verdict.REFUSED:
            assert verdict in (Verdict.OLDER, Verdict.KNOWN), verdict
        assert held.digest() == before

    def stream(data: bytes) -> None:
        unframer, step = frames.Unframer(limit=1 << 16), rng.randint(1, 400)
        for at in range(0, len(data), step):
            for message in unframer.feed(data[at : at + step]):
                kind = str(message.get("type"))
                _READERS.get(kind, frames.read_records)(message)

    readers: list[tuple[str, Callable[[bytes], object]]] = [
        ("offer", offer),
        ("stream", stream),
        ("plain", lambda data: from_plain(read_json(data, 1 << 17))),
    ]
    for number in range(cases):
        data = damaged(rng, good)
        name, read = readers[number % len(readers)]
        try:
            read(data)
            outcomes[f"{name} read"] += 1
        except RecordError as error:
            outcomes[f"{name} {error.reason}"] += 1
    return outcomes


_READERS: dict[str, Callable[..., object]] = {
    "challenge": frames.read_challenge,
    "greeting": frames.read_greeting,
    "have": frames.read_have,
    "ping": lambda message: message,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1 << 32))
    asked = parser.parse_args()
    print(f"seed {asked.seed}")
    for outcome, count in sorted(run(asked.cases, asked.seed).items()):
        print(f"{count:9d}  {outcome}")


if __name__ == "__main__":
    main()
