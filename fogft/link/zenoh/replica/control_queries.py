"""Answer a robot's queries other than requests: greetings, probes, records, answer streams.

Zenoh's threads only decode queries and hand them over; the worker thread answers them. Ending a
query is queued behind its robot's replies. Requests and replies: `listener`, `reply_queue`.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from typing import TypeVar

import zenoh

from fogft.counters import Counters
from fogft.errors import FrameError
from fogft.link import frame, probe_frames
from fogft.link.compression import ACCEPTED
from fogft.link.port import Probe, ProbeAnswer
from fogft.link.zenoh.replica.query_ends import QueryEnd
from fogft.link.zenoh.replica.reply_queue import ReplyQueues
from fogft.link.zenoh.replica.reply_streams import Streams
from fogft.link.zenoh.replica.sessions import AuthenticatedSessions, NotAdmittedError
from fogft.link.zenoh.work_queue import WorkQueue
from fogft.model.refusal import Refusal
from fogft.records import frames
from fogft.records.record import RecordError, SignedRecord, read_body
from fogft.records.record_set import RecordSet, Verdict

log = logging.getLogger(__name__)

T = TypeVar("T")
_STRANGERS = b""  # in place of a token: the reply queue of unknown connections


@dataclass(eq=False)
class ControlQueries:
    """Answers the queries of robots; `records` holds the pool's signed records known here."""

    _: KW_ONLY
    sessions: AuthenticatedSessions
    records: RecordSet
    streams: Streams
    queues: ReplyQueues
    work: WorkQueue
    counters: Counters

    def open_answers(self, asked: QueryEnd) -> None:
        """Handle the query of an admitted connection that opens its stream of answers."""
        try:
            token = _greeting(asked.query).token
        except FrameError as error:
            self._malformed(error, asked)
            return
        holder = self.sessions.of(token)
        if holder is None:
            self._turn_away(asked, Refusal.NOT_ADMITTED, "it did not greet")
            return
        for gone, query in self.streams.opened(token, asked.query, holder.common_name):
            self.queues.end(gone, "gone", QueryEnd(query, asked.turn))

    def probe(self, on_probe: Callable[[Probe], ProbeAnswer], asked: QueryEnd) -> None:
        """Handle a probe, which may carry a greeting."""

        def answer(probe: Probe) -> bytes:
            said = replace(on_probe(probe), accepts=ACCEPTED)
            return probe_frames.encode_probe_answer(said)

        self._handle(asked, "probes", probe_frames.decode_probe, answer)

    def exchange(self, asked: QueryEnd) -> None:
        """Handle signed records that a robot passes on."""

        def answer(offered: Sequence[SignedRecord]) -> bytes:
            newer = self.take(offered)
            return frames.pack(newer) if newer else b""

        self._handle(asked, "records", frames.unpack, answer)

    def _handle(
        self, asked: QueryEnd, event: str, read: Callable[[bytes], T], answer: Callable[[T], bytes]
    ) -> None:
        self.counters.add(event)
        payload = asked.query.payload
        try:
            greeting = _greeting(asked.query)
            content = read(payload.to_bytes() if payload else b"")
        except (FrameError, RecordError) as error:
            self._malformed(error, asked)
            return
        job = partial(self._answer, greeting, asked, partial(answer, content))
        self.later(greeting, job, asked)

    def later(self, greeting: frame.Greeting, job: Callable[[], None], asked: QueryEnd) -> None:
        """Run a job on the worker thread; if its sender's lane is full, just end the query."""
        known = self.sessions.of(greeting.token)
        # An unverified certificate may claim any name.
        lane = known.common_name.encode() if known else b"\0" + greeting.certificate
        if not self.work.offer(job, lane, always=known is not None):
            self._end_of_stranger(asked, "")

    def _turn_away(self, asked: QueryEnd, refusal: str, why: str) -> None:
        self.counters.warn(log, "not_admitted", "robot_not_admitted reason=%r", why)
        self._end_of_stranger(asked, refusal)

    def _malformed(self, error: ValueError, asked: QueryEnd) -> None:
        self.counters.warn(log, "malformed", "request_malformed reason=%r", str(error))
        self._end_of_stranger(asked, Refusal.MALFORMED)

    def _end_of_stranger(self, asked: QueryEnd, refusal: str) -> None:
        asked.refusal = refusal
        self.queues.end(_STRANGERS, "strangers", asked)

    def _answer(
        self, greeting: frame.Greeting, asked: QueryEnd, answer: Callable[[], bytes]
    ) -> None:
        try:
            self.sessions.greet(greeting)
        except NotAdmittedError as error:
            self._turn_away(asked, error.refusal, str(error))
            return
        try:
            asked.query.reply(asked.query.key_expr, answer(), express=True)
        finally:
            # On its robot's own thread: unlike the answer, the end is queued behind replies.
            self.queues.end(greeting.token, "probe", asked)

    def take(self, offered: Sequence[SignedRecord]) -> list[SignedRecord]:
        """Apply valid records; return our newer ones for those that are out of date."""
        newer: list[SignedRecord] = []
        for one in offered:
            verdict = self.records.offer(one)
            if verdict is Verdict.REFUSED:
                why = self.records.last_refusal
                self.counters.warn(log, "records_refused", "record_refused reason=%r", why)
            elif verdict is Verdict.OLDER:
                self.counters.add("records_older")
                record = read_body(one)
                held = self.records.get(record.kind, record.subject)
                newer += [] if held is None else [held.signed]
        self.sessions.revoke(self.records.revoked)
        return newer


def _greeting(query: zenoh.Query) -> frame.Greeting:
    attachment = query.attachment
    return frame.decode_greeting(attachment.to_bytes() if attachment else b"")
