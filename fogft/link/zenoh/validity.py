"""Whose clock is wrong, in words, when a certificate is refused for its time. Pure but for parsing.

A certificate begins 24 hours before it was made. So one that is "not yet valid" was made by
a clock a day ahead of the one that judges it, and TLS's word for it helps nobody.

Owns: those words. Not here: asking for the other end's certificate (`diagnosis`).
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass


@dataclass(frozen=True)
class Validity:
    """When a certificate is good. Times in UTC."""

    begins: datetime.datetime
    ends: datetime.datetime


def validity_of(certificate: bytes) -> Validity | None:
    """Return when a certificate (PEM or DER) is good; None where it cannot be read."""
    from cryptography import x509

    try:
        load = (
            x509.load_pem_x509_certificate
            if certificate.lstrip().startswith(b"-----")
            else x509.load_der_x509_certificate
        )
        read = load(certificate)
    except Exception:  # the parser may raise anything on hostile bytes
        return None
    return Validity(read.not_valid_before_utc, read.not_valid_after_utc)


def judged_here(validity: Validity, now: datetime.datetime) -> str:
    """Return why we refuse a replica's certificate: ``now`` is this machine's clock."""
    if now < validity.begins:
        return (
            f"it is not yet valid: it begins at {_utc(validity.begins)}, and this machine's clock "
            f"says {_utc(now)}. Set this machine's clock, or the manager's, which made it"
        )
    if now >= validity.ends:
        return (
            f"it expired at {_utc(validity.ends)}, and this machine's clock says {_utc(now)}. If "
            "that is right, replace the replica"
        )
    return ""


def judged_there(validity: Validity, now: datetime.datetime) -> str:
    """Return why a replica refuses our certificate for its time."""
    if now < validity.begins or now >= validity.ends:
        which = "has not begun" if now < validity.begins else "has expired"
        return (
            f"our certificate {which} (good from {_utc(validity.begins)} to {_utc(validity.ends)}, "
            f"this machine's clock says {_utc(now)})"
        )
    return (
        f"the replica's clock is wrong: it holds our certificate to be out of its time, which is "
        f"good from {_utc(validity.begins)} to {_utc(validity.ends)}; this machine's clock says "
        f"{_utc(now)}"
    )


def _utc(time: datetime.datetime) -> str:
    return f"{time:%Y-%m-%d %H:%M} UTC"
