"""What orders carry where several robots share a sequencer. Pure values and their bytes.

Owns: the bytes of entries, votes, requests handed in and what a replica tells when looked at.
Not here: what orders there are (`ordering`), what becomes of them (`shared_sequencer`,
`shared_replica`, `shared_robot`). Protocol: docs/design/state.md, "Several robots".
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

from fogft.ordering.orders import OrderError, Position

_ENTRY = struct.Struct(">BQQQ")
_VOTE = struct.Struct(">QQBBQQ")
_STANDING = struct.Struct(">QQBQ")
_POSITION = struct.Struct(">QQ")
_WORD_AND_FLAG = struct.Struct(">QB")
_WORD = struct.Struct(">Q")
_LENGTH = struct.Struct(">I")
_HANDED = struct.Struct(">QQQI")

OVERLOADED = "overloaded"
ID_LIMIT = 1 << 64


class RequestId(NamedTuple):
    """Which request: the run of a client proxy (64 random bits), and a number of its own."""

    session: int
    seq: int


NO_REQUEST = RequestId(0, 0)


@dataclass(frozen=True)
class Entry:
    """What has a number: a request, or (with `members`) who the members are from here on.

    Attributes:
        floor: The session awaits no answer below this number.
        wanted: Whether the sequencer's own robot asks: it is to be told the answer.
    """

    id: RequestId = NO_REQUEST
    floor: int = 0
    body: bytes = b""
    wanted: bool = False
    members: tuple[int, ...] = ()

    def encode(self) -> bytes:
        """Return it as bytes."""
        kind = 2 if self.members else int(self.wanted)
        body = _words(self.members) if self.members else self.body
        return _ENTRY.pack(kind, *self.id, self.floor) + body


def decode_entry(payload: bytes) -> Entry:
    """Read what `Entry.encode` wrote. Raises OrderError."""
    head, body = _split(_ENTRY, payload)
    kind, session, seq, floor = head
    if kind > 2 or (kind == 2 and not body):
        raise OrderError(f"no entry of kind {kind}")
    if kind == 2:
        return Entry(members=_read_words(body))
    return Entry(RequestId(session, seq), floor, body, bool(kind))


@dataclass(frozen=True)
class Vote:
    """What a replica answers to a claim.

    Attributes:
        sound: Its state is that of `position`.
        whole: It still has, or has again, all that it ever said to have applied.
        member: Who it is: 64 bits, drawn when its process began.
        life: How often its service has lost its state.
        members: Who the members are, at its position; none before the first term.
    """

    position: Position
    sound: bool
    whole: bool
    member: int
    life: int
    members: tuple[int, ...] = ()

    def encode(self) -> bytes:
        """Return it as bytes."""
        at = self.position
        head = _VOTE.pack(at.epoch, at.index, self.sound, self.whole, self.member, self.life)
        return head + _words(self.members)


def decode_vote(payload: bytes) -> Vote:
    """Read what `Vote.encode` wrote. Raises OrderError."""
    (epoch, index, sound, whole, member, life), rest = _split(_VOTE, payload)
    at = Position(epoch, index)
    return Vote(at, bool(sound), bool(whole), member, life, _read_words(rest))


@dataclass(frozen=True)
class Standing:
    """What a replica tells whoever looks.

    Attributes:
        promised: The term that it obeys.
        heard: How many orders of whom it obeys have come: it grows while that one lives.
        joined: Whether it applies requests, and takes those that are handed in.
        robot: Whom it obeys.
        begun: Whether it knows that the service has begun: its first members are committed.
    """

    promised: int
    heard: int
    joined: bool
    member: int
    members: tuple[int, ...] = ()
    robot: str = ""
    begun: bool = False

    def encode(self) -> bytes:
        """Return it as bytes."""
        flags = self.joined | self.begun << 1
        head = _STANDING.pack(self.promised, self.heard, flags, self.member)
        words = _words(self.members)
        return head + _LENGTH.pack(len(words)) + words + self.robot.encode()


def decode_standing(payload: bytes) -> Standing:
    """Read what `Standing.encode` wrote. Raises OrderError."""
    (promised, heard, flags, member), rest = _split(_STANDING, payload)
    (size,), rest = _split(_LENGTH, rest)
    robot = rest[size:].decode(errors="replace")
    members = _read_words(rest[:size])
    return Standing(promised, heard, bool(flags & 1), member, members, robot, bool(flags & 2))


@dataclass(frozen=True)
class Handed:
    """A request that a robot handed in at a replica."""

    id: RequestId
    floor: int
    body: bytes

    def encode(self) -> bytes:
        """Return it as bytes, of which many may follow each other."""
        return _HANDED.pack(*self.id, self.floor, len(self.body)) + self.body


def decode_handed(payload: bytes) -> list[Handed]:
    """Read any number of requests. Raises OrderError."""
    found = []
    while payload:
        (session, seq, floor, size), rest = _split(_HANDED, payload)
        if size > len(rest):
            raise OrderError("a request that was handed in is cut off")
        found.append(Handed(RequestId(session, seq), floor, rest[:size]))
        payload = rest[size:]
    return found


def encode_joined(member: int, expected: int, applied: int) -> bytes:
    """Return who has joined, which number it expects next, and which it has applied."""
    return _words((member, expected, applied))


def decode_joined(payload: bytes) -> tuple[int, int, int]:
    """Read what `encode_joined` wrote. Raises OrderError."""
    words = _read_words(payload)
    if len(words) != 3:
        raise OrderError(f"{len(words)} words instead of 3")
    return words[0], words[1], words[2]


def encode_applied(member: int, answer: bytes | None) -> bytes:
    """Return who has applied a number, and its answer where there is one and it is wanted."""
    return _WORD_AND_FLAG.pack(member, answer is not None) + (answer or b"")


def decode_applied(payload: bytes) -> tuple[int, bytes | None]:
    """Read what `encode_applied` wrote. Raises OrderError."""
    (member, answered), answer = _split(_WORD_AND_FLAG, payload)
    return member, answer if answered else None


def encode_word(word: int, rest: bytes = b"") -> bytes:
    """Return a number of 64 bits before some bytes."""
    return _WORD.pack(word) + rest


def decode_word(payload: bytes) -> tuple[int, bytes]:
    """Read a number before some bytes. Raises OrderError."""
    (word,), rest = _split(_WORD, payload)
    return word, rest


def encode_listen(committed: int, *, again: bool) -> bytes:
    """Return what is committed, and whether all is to be told that was told before."""
    return _WORD_AND_FLAG.pack(committed, again)


def decode_listen(payload: bytes) -> tuple[int, bool]:
    """Read what `encode_listen` wrote. Raises OrderError."""
    (committed, again), _ = _split(_WORD_AND_FLAG, payload)
    return committed, bool(again)


def encode_answer(at: Position, answer: bytes) -> bytes:
    """Return a response after the position of its request."""
    return _POSITION.pack(at.epoch, at.index) + answer


def decode_answer(payload: bytes) -> tuple[Position, bytes]:
    """Read what `encode_answer` wrote. Raises OrderError."""
    (epoch, index), rest = _split(_POSITION, payload)
    return Position(epoch, index), rest


def _words(words: tuple[int, ...]) -> bytes:
    return struct.pack(f">{len(words)}Q", *words)


def _read_words(payload: bytes) -> tuple[int, ...]:
    if len(payload) % _WORD.size:
        raise OrderError(f"{len(payload)} bytes are no list of words")
    return struct.unpack(f">{len(payload) // _WORD.size}Q", payload)


def _split(layout: struct.Struct, payload: bytes) -> tuple[tuple[int, ...], bytes]:
    if len(payload) < layout.size:
        raise OrderError(f"{len(payload)} bytes are too few")
    return layout.unpack_from(payload), payload[layout.size :]
