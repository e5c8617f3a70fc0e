"""Watch for the preemption notice of the machine that this process runs on.

A thread asks the cloud's metadata server (AWS, GCP, Azure: a link-local address that only the
machine itself reaches) or looks at a file, about once a second, and reports each kind of
notice once. A metadata server that does not answer is no news: on most machines there is none.

Owns: where each cloud is asked, and how often.
Not here: reading the answers (`notice_formats`) and what a replica does about it.
"""

from __future__ import annotations

import contextlib
import http.client
import logging
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

from fogft.cloud import notice_formats
from fogft.cloud.notice_formats import Notice, NoticeKind
from fogft.errors import CloudError
from fogft.model.names import NOTICE_SOURCES

log = logging.getLogger(__name__)

__all__ = ["Notice", "NoticeKind", "Watch", "watch"]

POLL_S = 1.0
FILE_POLL_S = 0.1  # costs nothing, and a local machine may live for a second only
LOST_POLL_S = 30.0
_TIMEOUT_S = 2.0
_METADATA = "169.254.169.254"
# The variables that the clouds' own clients know. Azure's have none.
_ELSEWHERE = {"aws": "AWS_EC2_METADATA_SERVICE_ENDPOINT", "gcp": "GCE_METADATA_HOST"}


class Source(Protocol):
    """Something that can be asked for notices."""

    def here(self) -> bool:
        """Whether this source exists on this machine."""

    def ask(self) -> Iterator[Notice]:
        """Yield the notices in force now, again each time. Raises OSError: it does not answer."""


class Watch:
    """A watch that runs until it is closed."""

    def __init__(
        self, sources: Sequence[Source], on_notice: Callable[[Notice], None], poll_s: float
    ) -> None:
        self._sources = list(sources)
        self._on_notice = on_notice
        self._poll_s = poll_s
        self._told: set[NoticeKind] = set()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="notice", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop; no call is made after this has returned, but one under way. Repeatable."""
        self._closed.set()

    def _run(self) -> None:
        source: Source | None = None
        failures = 0
        while not self._closed.is_set():
            if source is None:
                source = next((s for s in self._sources if s.here()), None)
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

    def _tell(self, source: Source) -> None:
        for notice in source.ask():
            if notice.kind in self._told or self._closed.is_set():
                continue
            self._told.add(notice.kind)
            log.warning(
                "notice_received kind=%s source=%s detail=%r",
                notice.kind.value,
                notice.source,
                notice.detail,
            )
            self._on_notice(notice)


def watch(
    source: str,
    on_notice: Callable[[Notice], None],
    *,
    poll_s: float | None = None,
    metadata: str | None = None,
) -> Watch:
    """Start to watch on a thread of its own.

    Args:
        source: ``file:PATH``, ``aws``, ``gcp``, ``azure``, or ``auto`` for whichever answers.
        on_notice: Called from that thread, once for each kind of notice; must not block.
        poll_s: Seconds between two looks; None for what suits the source.
        metadata: ``host[:port]`` of the metadata server; None for the clouds' own address,
            or for where the environment says that it is.

    Raises:
        CloudError: There is no such source.
    """
    if source.startswith("file:") and source != "file:":
        sources: list[Source] = [_File(Path(source.removeprefix("file:")))]
        poll_s = FILE_POLL_S if poll_s is None else poll_s
    elif source in NOTICE_SOURCES:
        known: dict[str, Source] = {
            "aws": _Aws(metadata or _address("aws")),
            "gcp": _Gcp(metadata or _address("gcp")),
            "azure": _Azure(metadata or _METADATA),
        }
        sources = list(known.values()) if source == "auto" else [known[source]]
    else:
        raise CloudError(
            f"there is no source of preemption notices `{source}`",
            f"`file:PATH`, {', '.join(f'`{name}`' for name in NOTICE_SOURCES)}",
        )
    return Watch(sources, on_notice, POLL_S if poll_s is None else poll_s)


def _address(cloud: str) -> str:
    told = os.environ.get(_ELSEWHERE[cloud], "").split("//")[-1].rstrip("/")
    return told or _METADATA


class _File:
    def __init__(self, path: Path) -> None:
        self._path = path

    def __str__(self) -> str:
        return f"file:{self._path}"

    def here(self) -> bool:
        return True

    def ask(self) -> Iterator[Notice]:
        with contextlib.suppress(FileNotFoundError):
            yield notice_formats.file_notice(self._path.read_text(errors="replace"))


class _Server:
    """A metadata server: plain HTTP, never through a proxy, answers of a few kilobytes."""

    name = ""

    def __init__(self, address: str) -> None:
        self._address = address

    def __str__(self) -> str:
        return self.name

    def _get(
        self, path: str, headers: dict[str, str], method: str = "GET"
    ) -> tuple[int, str, http.client.HTTPMessage]:
        connection = http.client.HTTPConnection(self._address, timeout=_TIMEOUT_S)
        try:
            connection.request(method, path, headers=headers)
            answer = connection.getresponse()
            body = answer.read(65_536).decode(errors="replace")
        except http.client.HTTPException as error:
            raise OSError(f"not an answer: {error!r}") from error
        finally:
            connection.close()
        return answer.status, body, answer.headers


class _Aws(_Server):
    """Instance metadata version 2: with a token, which is renewed when it is refused."""

    name = "aws"

    def __init__(self, address: str) -> None:
        super().__init__(address)
        self._token = ""

    def here(self) -> bool:
        with contextlib.suppress(OSError):
            return self._renewed()
        return False

    def ask(self) -> Iterator[Notice]:
        action = self._read("/latest/meta-data/spot/instance-action")
        notice = None if action is None else notice_formats.aws_action(action)
        if notice is not None:
            yield notice
        hint = self._read("/latest/meta-data/events/recommendations/rebalance")
        notice = None if hint is None else notice_formats.aws_rebalance(hint)
        if notice is not None:
            yield notice

    def _read(self, path: str) -> str | None:
        """Return an answer; None where there is nothing (404)."""
        status, body, _ = self._get(path, {"X-aws-ec2-metadata-token": self._token})
        if status == 401 and self._renewed():
            status, body, _ = self._get(path, {"X-aws-ec2-metadata-token": self._token})
        if status == 404:
            return None
        if status != 200:
            raise OSError(f"the metadata server answers {status}")
        return body

    def _renewed(self) -> bool:
        ttl = {"X-aws-ec2-metadata-token-ttl-seconds": "21600"}
        status, body, _ = self._get("/latest/api/token", ttl, "PUT")
        self._token = body.strip() if status == 200 else ""
        return bool(self._token)


class _Gcp(_Server):
    name = "gcp"
    _HEADERS = {"Metadata-Flavor": "Google"}  # noqa: RUF012

    def here(self) -> bool:
        with contextlib.suppress(OSError):
            return (
                self._get("/computeMetadata/v1/", self._HEADERS)[2].get("Metadata-Flavor")
                == "Google"
            )
        return False

    def ask(self) -> Iterator[Notice]:
        path = "/computeMetadata/v1/instance/preempted"
        status, body, _ = self._get(path, self._HEADERS)
        if status != 200:
            raise OSError(f"the metadata server answers {status}")
        notice = notice_formats.gcp_preempted(body)
        if notice is not None:
            yield notice


class _Azure(_Server):
    name = "azure"
    _HEADERS = {"Metadata": "true"}  # noqa: RUF012

    def __init__(self, address: str) -> None:
        super().__init__(address)
        self._machine = ""

    def here(self) -> bool:
        path = "/metadata/instance/compute/name?api-version=2021-02-01&format=text"
        with contextlib.suppress(OSError):
            status, body, _ = self._get(path, self._HEADERS)
            self._machine = body.strip() if status == 200 else ""
            return bool(self._machine)
        return False

    def ask(self) -> Iterator[Notice]:
        # The first question of all can take two minutes, while Azure begins to schedule.
        path = "/metadata/scheduledevents?api-version=2020-07-01"
        status, body, _ = self._get(path, self._HEADERS)
        if status != 200:
            raise OSError(f"the metadata server answers {status}")
        notice = notice_formats.azure_events(body, self._machine)
        if notice is not None:
            yield notice
