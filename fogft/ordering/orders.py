"""The orders between a sequencer and the replicas of a stateful service. Pure values.

An order is sent as an ordinary request whose 16-byte id is the order itself: operation, epoch and
index. So a request needs no envelope. Its answer is the payload defined for the operation, or a
refusal. Protocol: docs/design/state.md.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum
from functools import partial

_ID = struct.Struct(">QQ")
_JOIN = struct.Struct(">QQQ")
_PROMISE = struct.Struct(">QQB")
_INDEX = struct.Struct(">Q")
INDEX_LIMIT = 1 << 56
_EPOCH_LIMIT = 1 << 64
# Limits on what replicas may report: a lie beyond them would leave the sequencer no numbers.
_CLAIMED_INDEX_LIMIT, _CLAIMED_EPOCH_LIMIT = INDEX_LIMIT >> 1, _EPOCH_LIMIT >> 1


class OrderError(ValueError):
    """Bytes are not an order, or not the answer to one."""


class Op(IntEnum):
    """The operations that a sequencer can order."""

    CLAIM = 1
    JOIN = 2
    RESTORE = 3
    SNAPSHOT = 4
    APPLY = 5
    RECALL = 6  # return the answer to a number already applied; never applies it


OrderId = tuple[Op, int, int]  # operation, term, index


@dataclass(frozen=True, order=True)
class Position:
    """A state: all requests up to `index` of term `epoch`; by default, the initial state."""

    epoch: int = 0
    index: int = 0


START = Position()


@dataclass(frozen=True)
class Promise:
    """A replica's answer to a claim; `sound` is false after a failed restore."""

    position: Position
    sound: bool


def next_epoch(after: int, nonce: int) -> int:
    """Return an epoch above another, unique by 32 random bits. Raises ValueError: there is none."""
    epoch = ((after >> 32) + 1) << 32 | nonce
    if not 0 <= nonce < 1 << 32 or epoch >= _EPOCH_LIMIT:
        raise ValueError("no such epoch")
    return epoch


def encode(op: Op, epoch: int, index: int) -> bytes:
    """Return an order as a request id."""
    return _ID.pack(epoch, op << 56 | index)


def decode(id: bytes) -> OrderId:
    """Return operation, epoch and index of an order. Raises OrderError."""
    try:
        epoch, rest = _ID.unpack(id)
        return Op(rest >> 56), epoch, rest & (INDEX_LIMIT - 1)
    except (struct.error, ValueError) as error:
        raise OrderError(f"no order: {id.hex()}") from error


def encode_join(at: Position, last: int) -> bytes:
    """Encode the position that a replica must have to join, and the last number so far."""
    return _JOIN.pack(at.epoch, at.index, last)


def decode_join(payload: bytes) -> tuple[Position, int]:
    """Read what `encode_join` wrote. Raises OrderError."""
    epoch, index, last = _unpack(_JOIN, payload)
    return Position(epoch, index), last


def encode_promise(promise: Promise) -> bytes:
    """Return a promise as bytes."""
    return _PROMISE.pack(promise.position.epoch, promise.position.index, promise.sound)


def decode_promise(payload: bytes) -> Promise:
    """Read a promise. Raises OrderError."""
    epoch, index, sound = _unpack(_PROMISE, payload)
    if index >= _CLAIMED_INDEX_LIMIT:
        raise OrderError(f"a promise at the number {index}")
    return Promise(Position(epoch, index), bool(sound))


def encode_index(index: int) -> bytes:
    """Return an index as bytes."""
    return _INDEX.pack(index)


def decode_index(payload: bytes) -> int:
    """Read an index. Raises OrderError."""
    (index,) = _unpack(_INDEX, payload)
    return int(index)


def encode_snapshot(index: int, state: bytes) -> bytes:
    """Encode a state and an index: the state's own, or in a restore the last number so far."""
    return _INDEX.pack(index) + state


def decode_snapshot(payload: bytes) -> tuple[int, bytes]:
    """Read what `encode_snapshot` wrote. Raises OrderError."""
    return decode_index(payload[: _INDEX.size]), payload[_INDEX.size :]


def _unpack(layout: struct.Struct, payload: bytes) -> tuple[int, ...]:
    try:
        return layout.unpack(payload)
    except struct.error as error:
        raise OrderError(f"an answer of {len(payload)} bytes") from error


def _number(detail: str, base: int, limit: int) -> int | None:
    try:
        number = int(detail, base)
    except ValueError:
        return None
    return number if 0 <= number < limit else None


# Reads the next expected number from a `Refusal.GAP`.
read_index = partial(_number, base=10, limit=INDEX_LIMIT)
# Reads the current term from a `Refusal.FENCED`.
read_epoch = partial(_number, base=16, limit=_CLAIMED_EPOCH_LIMIT)
