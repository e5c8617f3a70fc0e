"""A process's membership records: kept on disk, exchanged with every rendezvous it can reach.

The client dials all endpoints in the background, again and again; no caller waits for it.

Not here: what records mean (`fogft.records.roster`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

from fogft.errors import FogftError, StateError
from fogft.model.credentials import CredentialPaths
from fogft.process import on_thread
from fogft.records.cache import restore, write
from fogft.records.dialling import connect
from fogft.records.exchange import Exchange
from fogft.records.record import Record, RecordKind, sign_record
from fogft.records.record_set import RecordSet, Verdict
from fogft.records.signing import Signer, Verifier

log = logging.getLogger(__name__)

CACHE_AFTER_S = 0.2
_LOOK_AFTER_OWN_EVERY_S = 5.0
_BACKOFF_S = 0.25
_END_WAIT_S = 2.0


@dataclass(frozen=True)
class Known:
    """The records known at one moment. Immutable, so any thread may read it."""

    records: tuple[Record, ...] = ()
    revoked: frozenset[str] = frozenset()
    connected: int = 0
    seen_host: str = ""  # our own address, as a rendezvous saw it; empty if none did

    def of(self, kind: RecordKind) -> list[Record]:
        """Return the records of a kind."""
        return [record for record in self.records if record.kind is kind]


@dataclass(eq=False)
class RendezvousClient:
    """Keeps the records of one process, and exchanges them with every rendezvous.

    `changed` is called on the client's thread after anything changed; it must not block.
    """

    endpoints: Sequence[str]
    credentials: CredentialPaths
    pool_uid: str
    _: KW_ONLY
    cache: Path | None = None
    changed: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self._signer = Signer(self.credentials.certificate, self.credentials.key)
        self._records = RecordSet(self.pool_uid, Verifier(self.credentials.ca))
        self._exchange = Exchange(self._records, self._news)
        self._own: dict[tuple[RecordKind, str], _Own] = {}
        self._details: dict[str, str] = dict.fromkeys(self.endpoints, "not reached yet")
        self._seen_host = ""
        self._cached, self._saving = False, threading.Lock()
        self.known = Known()
        if self.cache is not None and restore(self.cache, self._records, self.credentials.ca):
            self._cached = True
            self._refresh()
        self._loop = asyncio.new_event_loop()
        self._main: asyncio.Task[None]
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start dialling; return at once. Raises OSError: no thread can be started."""
        self._thread = on_thread(self._run, name="fogft-rendezvous")

    def close(self) -> None:
        """End all connections and write the cache. Repeatable."""
        if self._thread is not None and self._thread.is_alive():
            with contextlib.suppress(RuntimeError):  # it has just ended
                self._loop.call_soon_threadsafe(lambda: self._main.cancel())  # noqa: PLW0108 - set by then
            self._thread.join(_END_WAIT_S)

    def publish(
        self,
        kind: RecordKind,
        subject: str,
        generation: int,
        content: Mapping[str, Any],
        *,
        sequence: int | None = None,
    ) -> None:
        """Publish our own record from now on; without `sequence`, above older ones. Any thread."""
        own = _Own(generation, dict(content), sequence)
        self._loop.call_soon_threadsafe(self._say, kind, subject, own)

    def status(self) -> dict[str, Any]:
        """Return each rendezvous' problem and the counters, for people."""
        return {
            "rendezvous": [
                {"endpoint": endpoint, "connected": not detail, "detail": detail}
                for endpoint, detail in dict(self._details).items()
            ],
            "records": len(self.known.records),
            "offered": dict(self._records.counts),
        }

    # -- the client's thread ------------------------------------------------------------------

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._main = self._loop.create_task(self._live())
        try:
            self._loop.run_until_complete(self._main)
        except asyncio.CancelledError:
            pass
        except Exception:
            log.exception("rendezvous_client_ended")
        finally:
            self._save()
            self._loop.close()

    async def _live(self) -> None:
        steps = [*map(self._call, self.endpoints), self._keep_cache(), self._keep_own()]
        tasks = [self._loop.create_task(step) for step in steps]
        try:
            await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._exchange.abort()

    async def _call(self, endpoint: str) -> None:
        """Keep one rendezvous connected forever."""
        while True:
            began = time.monotonic()
            try:
                connection, seen_host = await connect(
                    endpoint, self.credentials, self._signer, self._records.pool_uid
                )
            except (FogftError, OSError, EOFError, ValueError, asyncio.TimeoutError) as error:
                self._detail(endpoint, str(error) or "it does not answer")
            else:
                self._seen_host = seen_host
                self._detail(endpoint, "")
                await self._exchange.keep(connection)
                self._detail(endpoint, "the connection was lost")
            await asyncio.sleep(max(0.0, began + _BACKOFF_S - time.monotonic()))

    def _detail(self, endpoint: str, detail: str) -> None:
        if self._details[endpoint] != detail:
            self._details[endpoint] = detail
            log.info("rendezvous_%s endpoint=%s reason=%r",
                     "lost" if detail else "connected", endpoint, detail)  # fmt: skip
            self._refresh()

    # -- own records ---------------------------------------------------------------------------

    def _say(self, kind: RecordKind, subject: str, own: _Own) -> None:
        self._own[kind, subject] = own
        self._look_after_own()

    def _assert_own(self, kind: RecordKind, subject: str, own: _Own) -> None:
        """Ensure that our current content is the record that counts, under our certificate."""
        found = self._records.get(kind, subject)
        held = None if found is None else found.record
        if found is not None and found.record.content == own.content:
            if own.sequence is not None:
                stands = found.record.order == (own.generation, own.sequence)
            else:
                renewed = found.signed.certificate != self._signer.certificate
                stands = found.record.generation == own.generation and not renewed
            if stands:
                return
        sequence = own.sequence
        if sequence is None:
            # An earlier process of ours may have published more than we know: continue above it.
            said = held is not None and held.generation == own.generation
            sequence = held.sequence + 1 if held is not None and said else 1
        record = Record(
            self._records.pool_uid, kind, subject, own.generation, sequence, own.content
        )
        if held is not None and held.order > record.order:
            if not own.superseded:
                own.superseded = True
                log.error(
                    "record_superseded kind=%s subject=%s order=%s standing=%s",
                    kind.value, subject, record.order, held.order,
                )  # fmt: skip
            return
        one = sign_record(record, self._signer)
        if not self._exchange.take([one]) and self._records.offer(one) is Verdict.REFUSED:
            log.error("record_refused kind=%s reason=%r", kind.value, self._records.last_refusal)

    async def _keep_own(self) -> None:
        while True:
            await asyncio.sleep(_LOOK_AFTER_OWN_EVERY_S)
            self._look_after_own()

    def _look_after_own(self) -> None:
        for (kind, subject), own in list(self._own.items()):
            try:
                self._assert_own(kind, subject, own)
            except (ValueError, StateError) as error:
                log.error("record_not_published kind=%s reason=%r", kind.value, str(error))

    # -- what changed --------------------------------------------------------------------------

    def _news(self) -> None:
        self._cached = False
        self._loop.call_soon(self._look_after_own)
        self._refresh()

    def _refresh(self) -> None:
        self.known = Known(
            records=tuple(one for kind in RecordKind for one in self._records.of(kind)),
            revoked=self._records.revoked,
            connected=sum(not detail for detail in self._details.values()),
            seen_host=self._seen_host,
        )
        try:
            self.changed()
        except Exception:
            log.exception("change_not_taken")

    # -- the cache -----------------------------------------------------------------------------

    async def _keep_cache(self) -> None:
        while True:
            await asyncio.sleep(CACHE_AFTER_S)
            if not self._cached:
                await asyncio.get_running_loop().run_in_executor(None, self._save)

    def _save(self) -> None:
        with self._saving:  # at the end, wait for a write under way: it would replace the last
            if self.cache is None or self._cached:
                return
            self._cached = True
            try:
                write(self.cache, self._records.lacking({}))
            except StateError as error:
                log.error("cache_not_written reason=%r", error.message)


@dataclass
class _Own:
    generation: int
    content: dict[str, Any]
    sequence: int | None
    superseded: bool = False
