"""Why a replica or its link refused a request, and the effect of each refusal. Pure.

A new kind of refusal needs a row here, code that raises it, and a test. The comment above a row
is published: `scripts/docs` writes it into docs/reference/diagnostics.md. Requests are refused
in `proxy/replica/responder` (services), `.goals_once`, `.topics`, `.ordered_responder` with
`ordering/replica` (services with `state`), `proxy/gateway/gateway`, `link/zenoh/replica` (who may
not ask; `.reply_queue`: lost answers), and on the robot in `link/zenoh/robot/attempts` and
`link/uplinks`. An older robot reads a new kind as UNKNOWN, which only uses up one of 3 attempts.
"""

from __future__ import annotations

from enum import Enum, Flag, auto


class Effect(Flag):
    """The effect of a refusal on the robot, besides asking another replica."""

    NONE = 0
    BLAMELESS = auto()  # not held against the request: the replica may never have begun it
    FINAL = auto()  # on a retry, this replica would run it twice, or refuse it again
    FAULT = auto()  # counts against the service
    OTHER_UPLINK = auto()  # the same replica may be reached through another uplink
    GOALS_LOST = auto()  # the action server may have lost the goals that it had


class Refusal(str, Enum):
    """The kinds of refusals: the text sent for each, and its effect."""

    effect: Effect

    def __new__(cls, text: str, effect: Effect = Effect.NONE) -> Refusal:
        """Make a member from its text and effect."""
        kind = str.__new__(cls, text)
        kind._value_ = text
        kind.effect = effect
        return kind

    # The service is not available
    NOT_READY = "not-ready", Effect.BLAMELESS | Effect.GOALS_LOST
    # The replica has too many requests, or would miss the deadline
    OVERLOADED = "overloaded", Effect.BLAMELESS
    # The service died while it worked on this
    CRASHED = "crashed", Effect.FAULT | Effect.GOALS_LOST
    # Its deadline passed before it was answered
    EXPIRED = "expired", Effect.FINAL
    # The request was run, but its answer is no longer stored
    FORGOTTEN = "forgotten", Effect.FINAL
    # The request, or the response, could not be read
    MALFORMED = "malformed", Effect.FINAL | Effect.FAULT
    # The sender has not been admitted
    NOT_ADMITTED = "not-admitted", Effect.BLAMELESS
    # The sender's certificate was revoked
    REVOKED = "revoked", Effect.BLAMELESS
    # The sender's certificate has expired by the replica's clock
    EXPIRED_CERTIFICATE = "expired-certificate"
    # Dropped because another replica answered first, or the caller gave up
    CANCELLED = "cancelled"
    # It was run, but another replica answered first
    LATE = "late"
    # A spare copy that would have had to wait
    BUSY = "busy", Effect.BLAMELESS

    # Of a stateful service; the last three have a detail
    # It follows this term, but does not have the state yet
    NOT_JOINED = "not-joined"
    # Another number is expected next (in decimal)
    GAP = "gap"
    # It follows a later term (in hexadecimal)
    FENCED = "fenced"
    # It follows another robot (by name)
    HELD = "held"

    # On the robot: a newer request replaced it before it was sent
    SUPERSEDED = "superseded", Effect.BLAMELESS
    # It would not arrive in time over this link
    TOO_SLOW = "too-slow", Effect.BLAMELESS | Effect.OTHER_UPLINK
    # The link died, or the replica lost the answer
    LOST = "lost", Effect.BLAMELESS | Effect.OTHER_UPLINK | Effect.GOALS_LOST
    # Unknown to this version; the detail has the original text
    UNKNOWN = "unknown"

    def __str__(self) -> str:
        """Return the text that is sent for the kind."""
        return str(self.value)

    def text(self, detail: str = "") -> str:
        """Return the refusal as sent over the link: ASCII."""
        said = f"{self.value}:{detail}" if detail else self.value
        return said.encode("ascii", "replace").decode()


def read(said: str) -> tuple[Refusal, str]:
    """Return the kind and the detail of a received refusal."""
    kind, _, detail = said.partition(":")
    try:
        return Refusal(kind), detail
    except ValueError:
        return Refusal.UNKNOWN, said
