"""The durable state of a sequencer: term, position of the last answer, and its version.

Four numbers in a memory-mapped file. A write is one store into the kernel's page cache: it
survives SIGKILL, and costs less than a microsecond.
"""

import mmap
import re
from pathlib import Path

from fogft import disk
from fogft.errors import StateError
from fogft.ordering.orders import Position, next_epoch

_MAGIC = int.from_bytes(b"fogmark1", "little")
# magic, the pool's uid, the term, the mark's epoch, the mark's index, the active version
_WORDS = 6
_TERM, _EPOCH, _INDEX, _HOLDER = 2, 3, 4, 5
_VERSION = re.compile(r"[0-9a-f]{16}")


class OrderMark:
    """The mark of one stateful service on one robot; its file is created if missing.

    Raises StateError: The file cannot be used, or belongs to another pool.
    """

    def __init__(self, path: Path, pool_uid: str) -> None:
        uid = int(pool_uid, 16)
        words = [_MAGIC, uid, 0, 0, 0, 0]
        try:
            if not path.exists():
                disk.make_folder(path.parent)
                disk.write_whole(path, b"".join(w.to_bytes(8, "little") for w in words))
            with path.open("r+b") as file:
                self._map = mmap.mmap(file.fileno(), _WORDS * 8)
        except (OSError, ValueError) as error:
            raise StateError(
                f"`{path}` cannot be used: {error}",
                "it records how far a stateful service is; recreate the pool with `fogft down`, "
                "then `fogft up`",
            ) from error
        self._words = memoryview(self._map).cast("Q")
        if self._words[0] != _MAGIC or self._words[1] != uid:
            raise StateError(f"`{path}` is not the order mark of this pool", "move it away")

    @property
    def position(self) -> Position:
        """The position of the last answer that was returned."""
        return Position(self._words[_EPOCH], self._words[_INDEX])

    @property
    def holder(self) -> str | None:
        """The version of the replicas that the last answer came from; None if unknown."""
        word = self._words[_HOLDER]
        return f"{word:016x}" if word else None

    def new_term(self, nonce: int, *, above: int = 0) -> int:
        """Store and return a new epoch, greater than `above` and all earlier ones."""
        self._version = self.holder or ""  # another process may have written meanwhile
        epoch = next_epoch(max(self._words[_TERM], above), nonce)
        self._words[_TERM] = epoch
        self._map.flush()
        return epoch

    def write(self, position: Position, version: str = "") -> None:
        """Store the position of the answer being returned, and the version it comes from."""
        # In this order: if killed between the two, the file never claims more than exists,
        # since an index never falls when a term begins.
        if self._words[_EPOCH] != position.epoch:
            self._words[_EPOCH] = position.epoch
        self._words[_INDEX] = position.index
        if version != self._version:  # last: the active version has the state up to the index
            self._version = version
            self._words[_HOLDER] = int(version, 16) if _VERSION.fullmatch(version) else 0

    def close(self) -> None:
        """Close the file."""
        self._words.release()
        self._map.close()
