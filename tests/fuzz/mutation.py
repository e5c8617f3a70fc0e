"""Damage a good input, by seed: for the short run, and where no coverage-guided fuzzer is."""

from __future__ import annotations

import random

INTERESTING = (b"", b"\0", b"\xff" * 4, b"{", b"[" * 64, b"NaN", b'"', b"\xed\xa0\x80", b"1e999")


def damaged(seeds: tuple[bytes, ...], dice: random.Random) -> bytes:
    """Return noise, or a seed with bytes changed, cut, repeated, spliced or added."""
    if dice.random() < 0.05:
        return dice.randbytes(dice.randrange(200))
    data = bytearray(dice.choice(seeds))
    for _ in range(dice.randrange(1, 5)):
        at = dice.randrange(len(data) + 1)
        kind = dice.randrange(6)
        if kind == 0 and data:
            data[at % len(data)] = dice.randrange(256)
        elif kind == 1:
            del data[at : at + dice.randrange(1, 9)]
        elif kind == 2:
            data[at:at] = dice.choice(INTERESTING)
        elif kind == 3:
            data[at:at] = data[: dice.randrange(1, 40)]
        elif kind == 4:
            del data[at:]
        else:
            other = dice.choice(seeds)
            data[at:] = other[dice.randrange(len(other) + 1) :]
    return bytes(data)
