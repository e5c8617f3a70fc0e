"""A pool's state on disk, as read and written by the manager and the commands.

Owns: the files of identity, spec, intent and membership.
Not here: what to remember (`fogft.planning`), what happened (`history_file`) and how a file is
replaced (`fogft.disk`).
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

from fogft import disk
from fogft.errors import PoolBusy, PoolNotFound, SpecError, StateError
from fogft.model.intent import Intent
from fogft.model.keys import only
from fogft.model.membership import from_dict, to_dict
from fogft.model.names import POOL_NAME_PATTERN, PoolUid
from fogft.model.plain import Count, from_plain, to_plain
from fogft.model.replica import Membership
from fogft.model.spec import PoolSpec
from fogft.planning.observed.services import Discovered
from fogft.planning.rollout import Trial
from fogft.pool.folder.history_file import HistoryFile
from fogft.pool.folder.paths import PoolPaths

_NO_INTENT = "remove it: then the pool file counts alone, without `scale`, `exclude` and `drain`"
_NO_IDENTITY = (
    "restore it, or remove the pool's folder, which ends the manager and the client proxy; "
    "`fogft sweep --end` then ends the machines"
)
_Name = Annotated[str, only(POOL_NAME_PATTERN.fullmatch, "a pool's name")]


@dataclass(frozen=True)
class Identity:
    """The permanent identity of a pool."""

    name: _Name
    uid: PoolUid
    cloud: _Name  # parts of paths, like the name
    file: str
    created_at: float
    first_epoch: Count = 0  # managers on this machine take epochs above it; see `lease`


@dataclass(frozen=True)
class GatewayPlace:
    """Where the launched gateway is; empty until that is known."""

    host: str = ""


class PoolStore(HistoryFile):
    """A pool's folder. Safe to use from several threads; one process writes each file.

    Raises `StateError`: a file cannot be written. Raises `PoolNotFound`: there is no such pool.
    """

    def __init__(
        self, paths: PoolPaths, parse: Callable[[str, str], PoolSpec], clock: Callable[[], float]
    ) -> None:
        self.paths = paths
        self.name = paths.folder.name  # the pool's name
        self._parse = parse
        super().__init__(paths.history, clock)
        self._spec: tuple[bytes, PoolSpec] | None = None
        self._good: tuple[bytes, PoolSpec] | None = None

    def identity(self) -> Identity:
        """Return the pool's identity."""
        return read_identity(self.paths)

    def spec(self) -> PoolSpec:
        """Return the pool file in force: as applied last, or the good one after a rollback."""
        raw = self._applied()
        trial = self.trial()
        if trial.fault and trial.file == digest(raw):
            good = self.good()
            if good is not None:
                return good
        self._spec = self._current(self._spec, raw)
        return self._spec[1]

    def _current(self, known: tuple[bytes, PoolSpec] | None, raw: bytes) -> tuple[bytes, PoolSpec]:
        """Return a file's spec with discovered services and gateway; the same object if known."""
        spec = known[1] if known is not None and known[0] == raw else self._read(raw)
        if not spec.services:
            found = disk.read_or(self.paths.discovered, Discovered())
            services = found.specs(spec.namespace)
            if (services, found.spec_hash) != (spec.discovered, spec.discovered_by):
                return raw, replace(spec, discovered=services, discovered_by=found.spec_hash)
        if spec.gateway.launch:
            host = disk.read_or(self.paths.gateway, GatewayPlace()).host
            if host and spec.dial_in != spec.gateway.endpoints(host)[2]:
                return raw, spec.behind(host)
        return raw, spec

    def _read(self, raw: bytes) -> PoolSpec:
        try:
            text = raw.decode()
        except UnicodeDecodeError as error:
            raise SpecError(
                f"`{self.paths.spec}` is damaged: {error}",
                "run `fogft up` to write it again, or `fogft down` to end the pool",
            ) from None
        return self._parse(text, self.identity().file)

    def _applied(self) -> bytes:
        raw = disk.read_bytes(self.paths.spec)
        if raw is None:
            raise PoolNotFound(f"pool `{self.paths.folder.name}` has no spec")
        return raw

    def applied(self) -> str:
        """Return the digest of the pool file that was applied last."""
        return digest(self._applied())

    def good(self) -> PoolSpec | None:
        """Return the last file with which all replicas were ready; None for none yet."""
        raw = disk.read_bytes(self.paths.good_spec)
        if raw is None:
            return None
        try:
            self._good = self._current(self._good, raw)
        except SpecError:  # it was good for a version of fogft that knew other keys
            return None
        return self._good[1]

    def keep_good(self, spec: PoolSpec) -> bool:
        """Store the file of `spec` as the last good one, if it was the last one read."""
        if self._spec is None or self._spec[1] is not spec:
            return False
        disk.write_whole(self.paths.good_spec, self._spec[0])
        return True

    def trial(self) -> Trial:
        """Return the trial of the last applied file, or of an earlier one."""
        return disk.read_or(self.paths.trial, Trial())  # damaged: the file is tried again

    def write_trial(self, trial: Trial) -> None:
        """Store the trial of the applied file."""
        disk.write_json(self.paths.trial, to_plain(trial))

    def intent(self) -> Intent:
        """Return the user's changes besides the file; empty if there are none."""
        return disk.read_as(Intent, self.paths.intent, _NO_INTENT) or Intent()

    def write_intent(self, intent: Intent) -> None:
        """Store the user's changes; the caller holds `intent_lock`."""
        disk.write_json(self.paths.intent, to_plain(intent))

    def place_gateway(self, host: str) -> None:
        """Store the host of the launched gateway: from now on, `spec` connects through it."""
        disk.write_json(self.paths.gateway, to_plain(GatewayPlace(host)))

    def membership(self) -> Membership | None:
        """Return the last written membership; None if it is missing or damaged."""
        try:
            raw = disk.read_json(self.paths.membership)
            return None if raw is None else from_dict(raw)
        except StateError:
            return None

    def write_membership(self, membership: Membership) -> None:
        """Publish a membership."""
        disk.write_json(self.paths.membership, to_dict(membership))


def digest(source: bytes) -> str:
    """Return 16 hexadecimal digits that identify a pool file's text."""
    return hashlib.sha256(source).hexdigest()[:16]


def read_identity(paths: PoolPaths) -> Identity:
    """Return the identity of the pool in a folder; if damaged, the one in the manager's status."""
    try:
        found = disk.read_as(Identity, paths.identity)
    except StateError as error:
        found = _told_identity(paths)
        if found is None:
            denied = isinstance(error.__cause__, PermissionError)
            hint = "run fogft as the user who owns it" if denied else _NO_IDENTITY
            raise StateError(error.message, hint) from error
    if found is None and paths.exported.exists():
        name = paths.folder.name
        raise PoolBusy(
            f"pool `{name}` was exported from this machine, or imported on another later",
            f"manage it where it was imported last; `fogft down {name}` removes what is left here",
        )
    if found is None:
        raise PoolNotFound(f"there is no pool `{paths.folder.name}`", "`fogft up FILE` starts one")
    return found


def _told_identity(paths: PoolPaths) -> Identity | None:
    """Return the identity that the manager last wrote to its status; None for none."""
    try:
        told = disk.read_json(paths.status)
        created_at = (paths.credentials / "ca.crt").stat().st_mtime
        also = {"name": told["pool"], "created_at": created_at, "first_epoch": told["epoch"]}
        found = from_plain(Identity, {**told, **also})
    except (StateError, OSError, LookupError, TypeError, ValueError):  # it is missing or damaged
        return None
    return found if found.name == paths.folder.name else None


def write_identity(paths: PoolPaths, identity: Identity) -> None:
    """Store a pool's identity; the caller holds `intent_lock`."""
    disk.write_json(paths.identity, to_plain(identity))
