"""A cache of records on disk, so that a process can start while no peer can be reached."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogft import disk
from fogft.errors import StateError
from fogft.model.membership import checksum
from fogft.model.plain import stored
from fogft.records.record import RecordError, SignedRecord, from_plain, to_plain
from fogft.records.record_set import RecordSet
from fogft.records.signing import Verifier

log = logging.getLogger(__name__)

VERSION = 1


@dataclass(frozen=True)
class _File:
    version: int
    checksum: str
    records: list[Any]


def content(records: Sequence[SignedRecord]) -> dict[str, Any]:
    """Return the content of a file with these records."""
    plain = [to_plain(one) for one in records]
    return {"version": VERSION, "checksum": checksum(plain), "records": plain}


def write(path: Path, records: Sequence[SignedRecord]) -> None:
    """Replace the file's content with these records."""
    disk.write_json(path, content(records))


def read(path: Path) -> list[SignedRecord]:
    """Return the records in the file; none if there is no file."""
    raw = disk.read_json(path)
    if raw is None:
        return []
    read = stored(_File, raw, f"`{path}` is damaged")
    if read.version != VERSION:
        raise StateError(f"`{path}` is of version {read.version}, not {VERSION}")
    try:
        if read.checksum != checksum(read.records):
            raise StateError(f"`{path}` is damaged: its checksum is wrong")
        return [from_plain(one) for one in read.records]
    except (RecursionError, RecordError) as error:
        raise StateError(f"`{path}` is damaged: {error}") from error


def restore(path: Path, records: RecordSet, ca: Path) -> bool:
    """Restore the records on disk, even of expired certificates; False if the file is damaged."""
    try:
        known = read(path)
    except StateError as error:  # peers send them again
        log.error("cache_damaged reason=%r", error.message)
        return False
    any_time = Verifier(ca, any_time=True)
    for one in known:
        records.offer(one, any_time)
    return True
