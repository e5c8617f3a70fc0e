"""Whose clock is wrong, in words."""

from __future__ import annotations

import datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.link.zenoh.diagnosis import judged_here, judged_there, validity_of
from fogft.pool.credentials import authority

DAY = datetime.timedelta(days=1)
NOW = datetime.datetime(2026, 11, 21, 12, 0, tzinfo=datetime.timezone.utc)


def test_a_certificate_of_tomorrow_names_both_clocks() -> None:
    said = judged_here((NOW + DAY, NOW + 9 * DAY), NOW)
    assert "not valid before 2026-11-22 12:00 UTC" in said
    assert "this machine's clock says 2026-11-21 12:00 UTC" in said


def test_a_good_certificate_that_is_refused_over_there_is_their_clocks_fault() -> None:
    said = judged_there((NOW - DAY, NOW + DAY), NOW)
    assert said.startswith("the replica's clock is wrong")


@given(st.integers(-9, 9), st.integers(0, 9))
def test_our_own_certificates_end_is_our_own_fault(begins: int, lasts: int) -> None:
    """The replica's clock is blamed exactly when ours finds nothing wrong."""
    validity = NOW + begins * DAY, NOW + (begins + lasts) * DAY
    blamed = judged_there(validity, NOW).startswith("the replica's clock")
    assert blamed == (judged_here(validity, NOW) == "")


def test_a_certificate_is_read_also_as_it_comes_from_elsewhere(tmp_path: Path) -> None:
    import ssl

    authority.create_authority(tmp_path, "0123456789abcdef")
    pem = (tmp_path / "ca.crt").read_bytes()
    read = validity_of(pem)
    assert read is not None
    der = ssl.PEM_cert_to_DER_cert(pem.decode())
    assert read == validity_of(ssl.DER_cert_to_PEM_cert(der).encode())
    assert read[1] - read[0] > 3000 * DAY


@pytest.mark.parametrize("junk", [b"", b"x", b"-----BEGIN CERTIFICATE-----", b"\x30" * 99])
def test_what_is_no_certificate_has_no_time(junk: bytes) -> None:
    assert validity_of(junk) is None
