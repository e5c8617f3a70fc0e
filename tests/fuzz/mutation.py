"""Damage a good input, by seed: for the short run, and where no coverage-guided fuzzer is."""

from __future__ import annotations

import copy
import json
import math
import random
from collections.abc import Iterator
from typing import Any

VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 0.5, 1e17, 1e300, -1e300, 10**400, 1 << 64, math.nan, math.inf, [], {}),
    *("", "1", "x" * 9000, "\x1b]0;owned\x07", "a\nb", "\ud800", [[[]]], {"": None}, [1e17], ["x"]),
)
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


def damaged_text(seed: bytes, dice: random.Random) -> bytes:
    """Return JSON, or lines of it, with other values in it; or whatever it is, with other bytes."""
    lines = seed.splitlines() if b"\n{" in seed else [seed]
    at = dice.randrange(len(lines))
    try:
        lines[at] = _other_values(json.loads(lines[at]), dice)
    except ValueError:
        return damaged((seed,), dice)
    return b"\n".join(lines) if dice.random() < 0.8 else damaged((seed,), dice)


def _other_values(tree: Any, dice: random.Random) -> bytes:
    """Change, drop, exchange, repeat, nest or rename one to three values."""
    for _ in range(dice.randrange(1, 4)):
        places = list(_places(tree))
        if not places:
            break
        holder, key = dice.choice(places)
        kind = dice.random()
        if kind < 0.15:
            del holder[key]
        elif kind < 0.3:  # what stands elsewhere is good there
            other, there = dice.choice(places)
            holder[key] = copy.deepcopy(other[there])
        elif kind < 0.4 and isinstance(holder[key], list) and holder[key]:
            holder[key] = copy.deepcopy(holder[key]) * dice.choice((2, 300))
        elif kind < 0.45:
            holder[key] = {"": [holder[key]]} if dice.random() < 0.5 else [holder[key]]
        elif kind < 0.55 and isinstance(holder, dict):
            holder[dice.choice(("", "\x1b[2J", key + "_", key.upper()))] = holder.pop(key)
        elif kind < 0.65 and isinstance(holder[key], (int, float)):
            holder[key] = -holder[key] if dice.random() < 0.5 else holder[key] * 10**9
        else:
            holder[key] = copy.deepcopy(dice.choice(VALUES))
    return json.dumps(tree).encode()


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each value's holder, and where in it the value stands."""
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        if isinstance(tree[key], (dict, list)):
            yield from _places(tree[key])
