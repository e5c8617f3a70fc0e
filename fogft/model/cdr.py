"""Check that bytes are a well-formed message of a type before a middleware reads them. Pure.

A middleware given bytes that it cannot read may fail, end its process, or read a different message.
Nothing is decoded here: whole runs of numbers are skipped. In plain CDR each field is aligned to
its own size, counted from the end of the four-byte header.
"""

import re
import struct
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

from fogft.model.type_definition import Fields

HEADER_BYTES = 4
_KEPT_BYTES = 16 << 10
_BYTE_ORDERS = {b"\x00\x00": struct.Struct(">I"), b"\x00\x01": struct.Struct("<I")}
# A middleware may pad a message's end to a multiple of its widest field. Fast DDS also leaves the
# unused bytes that it reserved for gaps between fields: fewer than the message has.
_MOST_PADDING = 7

NUMBER_BYTES = {
    **dict.fromkeys(("boolean", "octet", "byte", "char", "uint8", "int8"), 1),
    **dict.fromkeys(("uint16", "int16"), 2),
    **dict.fromkeys(("uint32", "int32", "float"), 4),
    **dict.fromkeys(("uint64", "int64", "double"), 8),
}
_SEQUENCE = re.compile(r"sequence<(?P<of>.+?)(?:, (?P<bound>\d+))?>")
_ARRAY = re.compile(r"(?P<of>.+)\[(?P<count>\d+)\]")
_STRING = re.compile(r"string(<\d+>)?")  # ROS holds no text to its bound, of characters or bytes


class _Malformed(Exception):
    """A message is malformed; the text says how."""


class _Uncheckable(Exception):
    """A field whose encoding differs between middlewares."""


class _Bytes:
    """A message's bytes, and the offsets of the booleans that were skipped.

    An offset may lie beyond the end: this is detected by the next read there, or by `Shape.fault`.
    """

    __slots__ = "booleans", "length_at", "payload", "size"

    def __init__(self, payload: bytes, length_at: struct.Struct) -> None:
        self.payload, self.length_at = payload, length_at.unpack_from
        self.size = len(payload)
        self.booleans: list[int] = []

    def check_booleans(self, first: int, end: int, step: int) -> None:
        """Check that each `step`-th byte between two offsets is 0 or 1."""
        highest = max(self.payload[first:end:step], default=0)
        if highest > 1:
            raise _Malformed(f"a boolean is {highest}")


_Walk = Callable[[_Bytes, int], int]  # from the offset of a value to the offset after it


class _Kind(NamedTuple):
    """How to skip a value of one type."""

    walk: _Walk
    align: int  # of its widest number: its start offset only matters modulo this
    has_fixed_size: bool  # its size depends only on its start offset


class Shape:
    """The shape of one message type: the one named `root` in `Definition.fields`."""

    def __init__(self, root: str, fields: Mapping[str, Fields]) -> None:
        self._fields = fields
        self._kinds: dict[str, _Kind] = {}
        # The last well-formed payload, if small: it is checked again before it is sent.
        self._good: bytes | None = None
        try:
            self._root: _Kind | None = self._message(root, ())
        except _Uncheckable:
            self._root = None

    def fault(self, payload: bytes) -> str:
        """Return the problem with a message's bytes, in words; empty if they are well-formed."""
        if payload is self._good:
            return ""
        length_at = _BYTE_ORDERS.get(payload[:2])
        if len(payload) < HEADER_BYTES or length_at is None:
            return f"{len(payload)} bytes without the header of a ROS 2 message"
        if self._root is None:
            return ""
        try:
            end = self._root.walk(_Bytes(payload, length_at), HEADER_BYTES)
            if end > len(payload):
                raise _Malformed(f"it ends {end - len(payload)} bytes early")
        except (_Malformed, struct.error) as error:
            return str(error) if isinstance(error, _Malformed) else "it ends within a length"
        left = len(payload) - end
        if left > _MOST_PADDING + end - HEADER_BYTES:
            return f"{left} bytes are left over"
        if len(payload) <= _KEPT_BYTES:
            self._good = payload
        return ""

    def _message(self, name: str, within: tuple[str, ...]) -> _Kind:
        if name not in self._kinds:
            if name not in self._fields or name in within:
                raise _Uncheckable(name)
            kinds = [self._kind(kind, (*within, name)) for _, kind in self._fields[name]]
            # ROS 2 gives a message without fields one byte.
            kinds = kinds or [_number("uint8")]
            self._kinds[name] = kinds[0] if len(kinds) == 1 else _one_after_another(kinds)
        return self._kinds[name]

    def _kind(self, kind: str, within: tuple[str, ...]) -> _Kind:
        if kind in NUMBER_BYTES:
            return _number(kind)
        if _STRING.fullmatch(kind):
            return _Kind(_skip_string, 4, False)
        if found := _ARRAY.fullmatch(kind):
            of = self._kind(found["of"], within)
            return _Kind(partial(_several, of, int(found["count"])), of.align, of.has_fixed_size)
        if found := _SEQUENCE.fullmatch(kind):
            return _sequence(self._kind(found["of"], within), int(found["bound"] or 0))
        return self._message(kind, within)


def _number(kind: str) -> _Kind:
    size = NUMBER_BYTES[kind]

    def walk(data: _Bytes, at: int) -> int:
        return at - (at - HEADER_BYTES) % -size + size

    def walk_boolean(data: _Bytes, at: int) -> int:
        data.booleans.append(at)
        if data.payload[at : at + 1] > b"\1":
            data.check_booleans(at, at + 1, 1)
        return at + 1

    return _Kind(walk_boolean if kind == "boolean" else walk, size, True)


def _skip_string(data: _Bytes, at: int) -> int:
    at += -(at - HEADER_BYTES) % 4
    length: int = data.length_at(data.payload, at)[0]
    return at + 4 + length


def _sequence(of: _Kind, bound: int) -> _Kind:
    def walk(data: _Bytes, at: int) -> int:
        at += 4 + -(at - HEADER_BYTES) % 4
        count: int = data.length_at(data.payload, at - 4)[0]
        if bound and count > bound:
            raise _Malformed(f"a sequence of at most {bound} elements has {count}")
        if count > data.size - at:  # each takes at least one byte
            raise _Malformed(f"it ends within a sequence of {count} elements")
        known = len(data.booleans)
        end = _several(of, count, data, at, keep=False)
        del data.booleans[known:]  # needed only to skip values of a fixed size in bulk
        return end

    return _Kind(walk, max(4, of.align), False)


def _one_after_another(kinds: list[_Kind]) -> _Kind:
    walks = [kind.walk for kind in kinds]

    def walk(data: _Bytes, at: int) -> int:
        for step in walks:
            at = step(data, at)
        return at

    align = max(kind.align for kind in kinds)
    return _Kind(walk, align, all(kind.has_fixed_size for kind in kinds))


def _several(of: _Kind, count: int, data: _Bytes, at: int, *, keep: bool = True) -> int:
    """Skip `count` values of one type, in bulk if each has the size of the one before."""
    while count:
        began, at = at, of.walk(data, at)
        count -= 1
        if count and of.has_fixed_size and (at - began) % of.align == 0:
            known = len(data.booleans)
            size = of.walk(data, at) - at
            end = at + size * count
            if end > data.size:
                return end
            for boolean in data.booleans[known:]:
                data.check_booleans(boolean, end, size)
                data.booleans += range(boolean + size, end, size) if keep else ()
            return end
    return at
