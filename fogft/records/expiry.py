"""When this process's own certificate expires. A manager renews only what it launched."""

import contextlib
import datetime
import logging
import time
from pathlib import Path

from fogft import disk

SOON = datetime.timedelta(days=30)  # a running manager renews a month earlier

log = logging.getLogger(__name__)


def end_of(certificate: bytes) -> float | None:
    """Return when a certificate (PEM) expires, in Unix time; None if it cannot be read."""
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificate(certificate).not_valid_after_utc.timestamp()
    except Exception:  # the parser may raise anything on hostile bytes
        return None


class Expiry:
    """Warns in the log, at start and once a day, that a certificate expires within `SOON`."""

    def __init__(self, certificate: Path) -> None:
        self._file = disk.Watched(certificate)
        self._end: float | None = None
        self._told_days: int | None = None

    def look(self) -> float | None:
        """Return for how many seconds it is valid, if known; call it in the main loop."""
        if self._file.changed():
            with contextlib.suppress(OSError):
                self._end = end_of(self._file.path.read_bytes())
        if self._end is None:
            return None
        left_s = self._end - time.time()
        days = int(left_s // 86_400)
        if days < SOON.days and days != self._told_days:
            self._told_days = days
            log.warning("certificate_expires in_days=%d path=%s remedy='join anew with a bundle of "
                        "`fogft credentials issue`'", days, self._file.path)  # fmt: skip
        return left_s
