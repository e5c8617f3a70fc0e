"""What the emulated clouds' own HTTP servers have in common."""

from __future__ import annotations

import json
from http.server import BaseHTTPRequestHandler
from typing import Any


class Answers:
    """Lets a handler answer JSON or text, and log nothing."""

    def log_message(self, *_: Any) -> None: ...

    def answer(self, body: Any, status: int = 200) -> None:
        assert isinstance(self, BaseHTTPRequestHandler)
        data = body.encode() if isinstance(body, str) else json.dumps(body).encode()
        self.send_response(status)
        self.send_header("content-length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)
