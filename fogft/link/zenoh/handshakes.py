"""Count the handshakes that Zenoh refuses, which it reports on standard output only.

So in a process that serves a port, standard output is redirected to an in-memory file that is read
periodically; a full pipe could block Zenoh. Output of the process itself and its children still
goes to the original standard output.
"""

import fcntl
import logging
import os
import re
import sys

log = logging.getLogger(__name__)

_ACCEPT = "zenoh_transport::unicast::establishment::accept"
_FILTER = f"zenoh_link_tls=warn,{_ACCEPT}=debug"
_LIMIT = 1 << 20
_REFUSED = re.compile(
    rf"(?:WARN .*zenoh_link_tls::unicast|{_ACCEPT}): (?P<reason>.*?)(\. Hint: .*)?$"
)
_ACCEPTED = "New transport link accepted"
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


class HandshakeLog:
    """Captures Zenoh's log; create it before any session. `stdout`: the original descriptor."""

    def __init__(self) -> None:
        import zenoh

        sys.stdout.flush()
        self.stdout = os.dup(1)
        self._file = os.memfd_create("fogft-zenoh-log", os.MFD_CLOEXEC)
        fcntl.fcntl(self._file, fcntl.F_SETFL, os.O_APPEND)
        os.dup2(self._file, 1)
        sys.stdout = os.fdopen(os.dup(self.stdout), "w", buffering=1)
        self._read_to = 0
        self._rest = b""
        zenoh.init_log_from_env_or(_FILTER)

    def refusals(self) -> list[str]:
        """Return the reasons of handshakes refused since the last call."""
        reasons = []
        for line in self._lines():
            text = _COLOUR.sub("", line.decode(errors="replace"))
            found = _REFUSED.search(text)
            if found:
                if not found["reason"].startswith(_ACCEPTED):
                    reasons.append(found["reason"].partition(" at /")[0])
            elif text.strip():
                log.info("zenoh_said text=%r", text)
        return reasons

    def _lines(self) -> list[bytes]:
        data = self._rest
        while chunk := os.pread(self._file, 1 << 16, self._read_to):
            data += chunk
            self._read_to += len(chunk)
        if self._read_to > _LIMIT:
            os.ftruncate(self._file, 0)  # opened with O_APPEND: the next line is at 0
            self._read_to = 0
        *lines, self._rest = data.split(b"\n")
        self._rest = self._rest[-4096:]
        return lines
