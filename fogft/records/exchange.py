"""Keep a set of records in sync with all connected peers. On one event loop.

Both ends do the same: list their records, send what the other end lacks, pass on new ones at once.

Not here: making connections (`server`, `dialling`).
"""

import asyncio
import itertools
import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fogft.records import frames
from fogft.records.record import RecordError, SignedRecord
from fogft.records.record_set import RecordSet, Verdict

log = logging.getLogger(__name__)

SILENCE_S = 3.0  # TCP alone would wait for minutes behind a black hole
PING_EVERY_S = 1.0
HAVE_EVERY = 5  # pings: repairs missed updates
OF_ONE_LIMIT = 8  # connections of one certificate; a newer one ends the oldest
_WAITING_LIMIT = 4 << 20
_READ_BYTES = 64 << 10


@dataclass(eq=False)
class Connection:
    """One open connection with an authenticated peer."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    unframer: frames.Unframer
    name: str

    def send(self, data: bytes) -> None:
        """Queue bytes; a peer that stops reading is disconnected."""
        if self.writer.transport.get_write_buffer_size() > _WAITING_LIMIT:
            self.abort()
            return
        self.writer.write(data)

    async def messages(self) -> list[dict[str, Any]]:
        """Return the next messages; an empty list at the end of the stream.

        Raises asyncio.TimeoutError if nothing came for `SILENCE_S`.
        """
        found = list(self.unframer.feed(b""))  # received along with the greeting
        while not found:
            data = await asyncio.wait_for(self.reader.read(_READ_BYTES), SILENCE_S)
            if not data:
                return []
            found = list(self.unframer.feed(data))
        return found

    def abort(self) -> None:
        """Close it at once."""
        self.writer.transport.abort()


class Exchange:
    """A record set and the connections over which it is kept in sync."""

    def __init__(self, records: RecordSet, changed: Callable[[], None] = lambda: None) -> None:
        self.records = records
        self.counts: Counter[str] = Counter()
        self._changed = changed
        self._connections: dict[Connection, None] = {}  # oldest first

    def __len__(self) -> int:
        return len(self._connections)

    def take(self, offered: list[SignedRecord], source: Connection | None = None) -> int:
        """Offer records to the set and pass on accepted ones; return their number."""
        accepted = [one for one in offered if self.records.offer(one) is Verdict.ACCEPTED]
        if accepted:
            for message in frames.records(accepted):
                for connection in self._connections.keys() - {source}:
                    connection.send(message)
            for connection in self._connections:
                if connection.name in self.records.revoked:
                    connection.abort()
            self._changed()
        return len(accepted)

    async def keep(self, connection: Connection) -> None:
        """Exchange records over a connection until it ends. Raises nothing but cancellation."""
        own = [one for one in self._connections if one.name == connection.name]
        if len(own) >= OF_ONE_LIMIT:
            self.counts["surplus"] += 1
            del self._connections[own[0]]
            own[0].abort()
        self._connections[connection] = None
        pings = asyncio.get_running_loop().create_task(self._ping(connection))
        try:
            while messages := await connection.messages():
                for message in messages:
                    self._heard(connection, message)
        except asyncio.TimeoutError:
            self.counts["silent"] += 1
            log.info("connection_silent peer=%s silent_for_s=%.0f", connection.name, SILENCE_S)
        except RecordError as error:
            self.counts[f"message_{error.reason}"] += 1
            log.warning("message_refused peer=%s reason=%r", connection.name, str(error))
        except OSError as error:
            log.info("connection_lost peer=%s reason=%r", connection.name, str(error))
        finally:
            pings.cancel()
            self._connections.pop(connection, None)
            connection.abort()

    async def _ping(self, connection: Connection) -> None:
        for count in itertools.count():
            due = frames.ping() if count % HAVE_EVERY else frames.have(self.records.digest())
            connection.send(due)
            await asyncio.sleep(PING_EVERY_S)

    def _heard(self, connection: Connection, message: dict[str, Any]) -> None:
        kind = message.get("type")
        if kind == "have":
            for answer in frames.records(self.records.lacking(frames.read_have(message))):
                connection.send(answer)
        elif kind == "records":
            self.take(frames.read_records(message), connection)
        elif kind != "ping":
            raise RecordError("malformed", "a message of an unknown kind")

    def abort(self) -> None:
        """End all connections."""
        for connection in list(self._connections):
            connection.abort()
