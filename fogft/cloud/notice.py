"""Watch for the preemption notice of the machine that this process runs on.

A thread polls the cloud's metadata server (AWS, GCP, Azure) or a file. At each poll a source yields
all notices in force; a poll without an answer has no effect.
"""

from __future__ import annotations

import contextlib
import http.client
import logging
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from fogft.cloud import notice_formats
from fogft.cloud.notice_formats import Notice, NoticeKind
from fogft.errors import CloudError
from fogft.model.names import NOTICE_SOURCES
from fogft.process import on_thread

log = logging.getLogger(__name__)

POLL_S = 1.0
FILE_POLL_S = 0.1  # costs nothing, and a local machine may live for a second only
LOST_POLL_S = 30.0
_TIMEOUT_S = 2.0
METADATA = "169.254.169.254"  # ``host[:port]`` of the metadata server


class Watch:
    """Polls for notices on its own thread and calls `on_notice` once for each kind of notice.

    `source` is ``file:PATH``, ``aws``, ``gcp``, ``azure``, or ``auto`` for whichever answers.
    """

    def __init__(self, source: str, on_notice: Callable[[Notice], None]) -> None:
        self._sources = _sources(source)
        self._on_notice = on_notice
        self._poll_s = FILE_POLL_S if isinstance(self._sources[0], _File) else POLL_S
        self._told: set[NoticeKind] = set()
        self._source: _Source | None = None
        self._closed = threading.Event()
        self.close = self._closed.set  # no new call after this, but one may still run; idempotent
        on_thread(self._run, name="notice")

    @property
    def silent(self) -> bool:
        """Whether no notice source has been found on this machine so far."""
        return self._source is None

    def _run(self) -> None:
        failures = 0
        while not self._closed.is_set():
            if self._source is None:
                self._source = next(filter(_is_here, self._sources), None)
            source = self._source
            if source is not None:
                try:
                    self._tell(source)
                    failures = 0
                except OSError as error:
                    failures += 1
                    if failures == 5:
                        log.warning("metadata_lost source=%r reason=%r", str(source), str(error))
            lost = source is None or failures >= 5
            self._closed.wait(max(self._poll_s, LOST_POLL_S) if lost else self._poll_s)

    def _tell(self, source: _Source) -> None:
        for notice in source.ask():
            if notice is None or notice.kind in self._told or self._closed.is_set():
                continue
            self._told.add(notice.kind)
            said = notice.kind.value, notice.source, notice.detail
            log.warning("notice_received kind=%s source=%s detail=%r", *said)
            self._on_notice(notice)


def _sources(source: str) -> list[_Source]:
    if source.startswith("file:") and source != "file:":
        return [_File(Path(source.removeprefix("file:")))]
    if source not in NOTICE_SOURCES:
        raise CloudError(
            f"unknown source of preemption notices `{source}`",
            f"`file:PATH`, {', '.join(f'`{name}`' for name in NOTICE_SOURCES)}",
        )
    # The environment variables are those of the clouds' own clients. Azure's clients have none.
    known: dict[str, _Source] = {
        "aws": _Aws(_address("AWS_EC2_METADATA_SERVICE_ENDPOINT")),
        "gcp": _Gcp(_address("GCE_METADATA_HOST"), **{"Metadata-Flavor": "Google"}),
        "azure": _Azure(METADATA, Metadata="true"),
    }
    return list(known.values()) if source == "auto" else [known[source]]


def _address(variable: str) -> str:
    return os.environ.get(variable, "").split("//")[-1].rstrip("/") or METADATA


def _is_here(source: _Source) -> bool:
    with contextlib.suppress(OSError):
        return source.is_here()
    return False


class _File:
    def __init__(self, path: Path) -> None:
        self._path = path

    def __str__(self) -> str:
        return f"file:{self._path}"

    def is_here(self) -> bool:
        return True

    def ask(self) -> Iterator[Notice]:
        with contextlib.suppress(FileNotFoundError):
            yield notice_formats.file_notice(self._path.read_text(errors="replace"))


class _Server:
    """A metadata server: plain HTTP, never through a proxy, answers of a few kilobytes."""

    def __init__(self, address: str, **headers: str) -> None:
        self._address = address
        self._headers = headers

    def __str__(self) -> str:
        return type(self).__name__.strip("_").lower()

    def _get(self, path: str, method: str = "GET") -> tuple[int, str, http.client.HTTPMessage]:
        connection = http.client.HTTPConnection(self._address, timeout=_TIMEOUT_S)
        try:
            connection.request(method, path, headers=self._headers)
            answer = connection.getresponse()
            body = answer.read(65_536).decode(errors="replace")
        except http.client.HTTPException as error:
            raise OSError(f"not an answer: {error!r}") from error
        finally:
            connection.close()
        return answer.status, body, answer.headers

    def _read(self, path: str) -> str:
        status, body, _ = self._get(path)
        if status != 200:
            raise OSError(f"the metadata server answers {status}")
        return body


class _Aws(_Server):
    """IMDSv2: requests carry a token, which is renewed when the server rejects it."""

    def is_here(self) -> bool:
        self._headers = {"X-aws-ec2-metadata-token-ttl-seconds": "21600"}
        status, body, _ = self._get("/latest/api/token", "PUT")
        token = body.strip() if status == 200 else ""
        self._headers = {"X-aws-ec2-metadata-token": token}
        return bool(token)

    def ask(self) -> Iterator[Notice | None]:
        for path, read in (
            ("spot/instance-action", notice_formats.aws_action),
            ("events/recommendations/rebalance", notice_formats.aws_rebalance),
        ):
            status, body, _ = self._get(f"/latest/meta-data/{path}")
            if status == 401 and self.is_here():
                status, body, _ = self._get(f"/latest/meta-data/{path}")
            if status == 200:
                yield read(body)
            elif status != 404:  # 404 means that there is no notice
                raise OSError(f"the metadata server answers {status}")


class _Gcp(_Server):
    def is_here(self) -> bool:
        return self._get("/computeMetadata/v1/")[2].get("Metadata-Flavor") == "Google"

    def ask(self) -> Iterator[Notice | None]:
        path = "/computeMetadata/v1/instance/preempted"
        yield notice_formats.gcp_preempted(self._read(path))


class _Azure(_Server):
    _machine = ""

    def is_here(self) -> bool:
        path = "/metadata/instance/compute/name?api-version=2021-02-01&format=text"
        self._machine = self._read(path).strip()
        return bool(self._machine)

    def ask(self) -> Iterator[Notice | None]:
        # The very first request can take two minutes, while Azure enables scheduled events.
        path = "/metadata/scheduledevents?api-version=2020-07-01"
        yield notice_formats.azure_events(self._read(path), self._machine)


_Source = _File | _Aws | _Gcp | _Azure
