"""Why a replica, or the link to it, did not answer a request. Pure."""

from __future__ import annotations


class Refusal:
    """Reasons of a refusal, as they travel. The robot tries elsewhere, or again later."""

    NOT_READY = "not-ready"  # the local service is not there
    OVERLOADED = "overloaded"  # the replica's own window is full
    CRASHED = "crashed"  # the service died while it worked on this
    EXPIRED = "expired"  # its deadline had passed on arrival
    FORGOTTEN = "forgotten"  # it was run, but the answer is no longer kept
    MALFORMED = "malformed"  # the request could not be read
    NOT_ADMITTED = "not-admitted"  # who asks may not, or did not say who it is
    REVOKED = "revoked"  # the certificate of who asks was taken back
    EXPIRED_CERTIFICATE = "expired-certificate"  # by the replica's clock
    CANCELLED = "cancelled"  # dropped, because the robot had its answer from elsewhere
    LATE = "late"  # it was run, but the robot had its answer from elsewhere
    SUPERSEDED = "superseded"  # made locally: a newer request took its place before it was sent
    TOO_SLOW = "too-slow"  # made locally: over this link it would not have arrived in time
    LOST = "lost"  # made locally: the link died before an answer came
