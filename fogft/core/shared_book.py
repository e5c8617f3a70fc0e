"""What every replica keeps beside the service's own state, where several robots share it. Pure.

Who the members are, and which requests were applied with what answer: so that a request that a
second sequencer numbers again is not applied again. It is part of the state: equal after equal
entries, and part of every snapshot.

Owns: members and answers, their bounds, their bytes. Not here: applying (`shared_replica`).
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from dataclasses import dataclass, field

from fogft.core.shared_orders import Entry, RequestId
from fogft.ordering.orders import OrderError

# More robots than will ever share a pool; the one that asked longest ago is forgotten.
SESSIONS_LIMIT = 256

_COUNT = struct.Struct(">I")
_SESSION = struct.Struct(">QQI")
_ANSWER = struct.Struct(">QQBI")


@dataclass(frozen=True)
class Applied:
    """A request that was applied: its number, and its answer (None: the service cannot read it)."""

    index: int
    answer: bytes | None


@dataclass
class _Session:
    floor: int = 0
    answers: dict[int, Applied] = field(default_factory=dict)


class Book:
    """Members, and answers by request."""

    def __init__(self) -> None:
        self.members: tuple[int, ...] = ()
        self._sessions: OrderedDict[int, _Session] = OrderedDict()

    def find(self, id: RequestId) -> Applied | None:
        """Return how a request was answered; None where it was not, or nobody awaits it."""
        session = self._sessions.get(id.session)
        return session.answers.get(id.seq) if session else None

    def is_new(self, id: RequestId) -> bool:
        """Whether a request is to be applied."""
        session = self._sessions.get(id.session)
        return session is None or (id.seq >= session.floor and id.seq not in session.answers)

    def forgets(self, id: RequestId) -> bool:
        """Whether its robot has said that it awaits no answer to it."""
        session = self._sessions.get(id.session)
        return session is not None and id.seq < session.floor

    def note(self, entry: Entry, applied: Applied) -> None:
        """Write down how an entry's request, which was new, was answered."""
        session = self._sessions.setdefault(entry.id.session, _Session())
        self._sessions.move_to_end(entry.id.session)
        session.answers[entry.id.seq] = applied
        if entry.floor > session.floor:
            session.floor = entry.floor
            for seq in [seq for seq in session.answers if seq < entry.floor]:
                del session.answers[seq]
        while len(self._sessions) > SESSIONS_LIMIT:
            self._sessions.popitem(last=False)

    def encode(self) -> bytes:
        """Return it as bytes, for a snapshot."""
        parts = [_COUNT.pack(len(self.members)), *(m.to_bytes(8, "big") for m in self.members)]
        parts.append(_COUNT.pack(len(self._sessions)))
        for name, session in self._sessions.items():
            parts.append(_SESSION.pack(name, session.floor, len(session.answers)))
            for seq, applied in session.answers.items():
                answer = applied.answer
                known, size = answer is not None, len(answer or b"")
                parts += [_ANSWER.pack(seq, applied.index, known, size), answer or b""]
        return b"".join(parts)


def decode(payload: bytes) -> tuple[Book, bytes]:
    """Read a book, and what comes after it.

    Raises:
        OrderError: It is none.
    """
    reader = _Reader(payload)
    book = Book()
    (count,) = reader.read(_COUNT)
    book.members = tuple(int.from_bytes(reader.bytes(8), "big") for _ in range(count))
    (count,) = reader.read(_COUNT)
    for _ in range(count):
        name, floor, answers = reader.read(_SESSION)
        session = book._sessions[name] = _Session(floor)
        for _ in range(answers):
            seq, index, known, size = reader.read(_ANSWER)
            answer = reader.bytes(size)
            session.answers[seq] = Applied(index, answer if known else None)
    return book, payload[reader.at :]


class _Reader:
    def __init__(self, payload: bytes) -> None:
        self.payload, self.at = payload, 0

    def bytes(self, size: int) -> bytes:
        found = self.payload[self.at : self.at + size]
        if len(found) != size:
            raise OrderError("a book is cut off")
        self.at += size
        return found

    def read(self, layout: struct.Struct) -> tuple[int, ...]:
        return layout.unpack(self.bytes(layout.size))
