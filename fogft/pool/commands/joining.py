"""Join bundles: their content, and how `fogft join` sets up a machine from one.

A bundle is used once: its file is deleted after use, and a copy is refused on this machine by its
id, and on others by the claim at the rendezvous. Existing files of the same holder are replaced,
the certificate last: a running proxy starts to use it by itself.

Owns: the content of bundles, and the folders of joined holders.
Not here: sealing (`bundle`), which certificates exist (`ledger`), claims (`claiming`).
"""

import contextlib
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from fogft import disk
from fogft.errors import CredentialError, FogftError, SpecError
from fogft.model.credentials import CredentialPaths, Holder, Role
from fogft.model.groups import FIRST_BY_HAND, LAST_BY_HAND
from fogft.model.keys import only
from fogft.model.membership import to_dict
from fogft.model.names import Endpoint
from fogft.model.plain import from_plain
from fogft.model.replica import ReplicaId
from fogft.model.spec import PoolSpec
from fogft.pool.credentials import bundle, claiming
from fogft.pool.credentials.authority import Credential
from fogft.pool.credentials.bundle import Label
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.store import PoolStore
from fogft.pool.manager import configuration
from fogft.poolfile import yaml_tree
from fogft.poolfile.tree import plain

_USED_LIMIT = 10_000
# A bundle may bring no other files: one in its folder could be a command that a proxy starts.
_BROUGHT = re.compile(
    r"(credentials/)?(ca\.crt|(robot|gateway|replica|rendezvous)\.(key|crt))"
    r"|(proxy|gateway|replica|rendezvous)\.yaml|membership\.json|announcements\.json"
)
# All others: `proxy`.
_COMMANDS = {Role.REPLICA: "serve", Role.RENDEZVOUS: "rendezvous", Role.GATEWAY: "gateway"}
_FLAT = (Role.REPLICA, Role.RENDEZVOUS)  # their credentials are stored beside their configuration


@dataclass(frozen=True)
class Joined:
    """The result of a `join`: ``fogft <command> --config <config>`` starts it.

    `alone`: there is no rendezvous to tell it of changes, or whether it is the first to join.
    """

    holder: Holder
    config: Path
    command: str
    alone: bool


def issue(
    store: PoolStore, role: Role, name: str, passphrase: str, now: float, *, open_for_s: float
) -> tuple[Holder, bytes]:
    """Certify the next generation of a holder; return it with its sealed bundle."""
    identity, spec = store.identity(), store.spec()
    if role is Role.REPLICA and not _is_by_hand(name):
        raise CredentialError(
            f"`{name}` is not a slot for a replica that is started manually",
            f"use {FIRST_BY_HAND} to {LAST_BY_HAND}: the manager launches and certifies the slots "
            "below",
        )
    _check_found(spec, role, name)
    bundle.check_passphrase(passphrase)  # before a generation is used up
    with disk.locked(store.paths.intent_lock):
        store.identity()  # raises if it was exported meanwhile
        ledger = Ledger(store.paths.credentials)
        holder, credential = ledger.issue_next(role, name, identity.uid)
    label = Label(secrets.token_hex(16), identity.name, holder.common_name, now, now + open_for_s)
    content = {"files": _files(store, holder, credential), "rendezvous": list(spec.rendezvous)}
    return holder, bundle.seal(label, content, passphrase)


def _is_by_hand(name: str) -> bool:
    number = name.isascii() and name.isdecimal() and str(int(name[:9])) == name
    return number and FIRST_BY_HAND <= int(name) <= LAST_BY_HAND


def _check_found(spec: PoolSpec, role: Role, name: str) -> None:
    """Check that a new member can find the others, or be found by them."""
    if spec.rendezvous:
        return
    add = "add `fogft.rendezvous` to the pool file and run `fogft up`"
    if role is Role.REPLICA and not spec.dial_in:
        raise CredentialError(
            f"replica `{name}` could not be found: the pool has no rendezvous",
            f"{add}, or set `fogft.dial_in` so that it dials the robot",
        )
    if role in (Role.ROBOT, Role.GATEWAY) and spec.dial_in:
        raise CredentialError(
            f"{role.value} `{name}` would find no replica: replicas dial this machine's robot, "
            "and only a rendezvous can tell them about others",
            add,
        )


def _files(store: PoolStore, holder: Holder, credential: Credential) -> dict[str, str]:
    identity, spec = store.identity(), store.spec()
    files: dict[str, str] = {}
    if holder.role is Role.REPLICA:
        id = ReplicaId(identity.uid, int(holder.name), holder.generation)
        signed = store.paths.announcements
        known = signed.exists()
        files["replica.yaml"] = configuration.replica_config(
            identity, spec, id, announcements=known
        )
        if known:
            files[signed.name] = signed.read_text()
    elif holder.role is Role.RENDEZVOUS:
        files["rendezvous.yaml"] = configuration.rendezvous_config(identity)
    else:
        files[f"{_COMMANDS.get(holder.role, 'proxy')}.yaml"] = configuration.proxy_config(
            identity, spec, name=holder.name, role=holder.role
        )
        membership = store.membership()
        if membership is not None:
            files["membership.json"] = disk.to_json(to_dict(membership))
    # The certificate last: once it exists, all other files do too.
    folder = "" if holder.role in _FLAT else "credentials/"
    own = credential.files(holder.role.value)
    return {**files, **{f"{folder}{name}": text.decode() for name, text in own.items()}}


def join(file: Path, passphrase: str, root: Path, now: float) -> Joined:
    """Set up this machine from a bundle, and delete the bundle.

    Raises:
        CredentialError: The file is no bundle, was used or is too old, or the passphrase is wrong;
            or no rendezvous can tell whether it was used: then it can still be used.
        StateError: A file cannot be written; the bundle still exists.
    """
    label, content = bundle.open_sealed(read(file), passphrase, now)
    brought = read_content(content)
    files, endpoints = brought.files, list(brought.rendezvous)
    holder = label.holder
    pool = "".join(c for c in label.pool if c.isalnum() or c == "-")
    folder = root / "joined" / f"{pool}.{holder.role.value}.{holder.name}"
    config = folder / (f"{holder.role.value}.yaml" if holder.role in _COMMANDS else "proxy.yaml")
    with used_once(root, label):
        if holder.pool_uid.encode() not in (disk.read_bytes(config) or holder.pool_uid.encode()):
            raise CredentialError(
                f"`{folder}` belongs to another pool of this name",
                "if that pool is gone, remove the folder; the bundle is as good as before",
            )
        if endpoints:
            token = claiming.own_token(root / "joined" / "claims.json", label.id, now)
            with _on_disk(root / "joined", files, holder) as credentials:
                claiming.claim(holder, token, endpoints, credentials)
        for name, text in files.items():
            place = folder / name
            disk.make_folder(place.parent)
            disk.write_whole(place, text)
    destroy(file)
    alone = not endpoints and holder.role is not Role.RENDEZVOUS
    return Joined(holder, config, _COMMANDS.get(holder.role, "proxy"), alone)


@contextlib.contextmanager
def used_once(root: Path, label: Label) -> Iterator[None]:
    """Record a bundle as used on this machine if the body succeeds."""
    used = root / "joined" / "used.json"
    disk.make_folder(used.parent)
    with disk.locked(used.with_suffix(".lock")):
        ids = disk.read_as(list[str], used) or []
        if label.id in ids:
            raise CredentialError(
                f"this bundle for `{label.holder.short}` was already used on this machine",
                "a bundle can be used only once: request a new one",
            )
        yield
        disk.write_json(used, [*ids, label.id][-_USED_LIMIT:])


@contextlib.contextmanager
def _on_disk(folder: Path, files: Mapping[str, str], holder: Holder) -> Iterator[CredentialPaths]:
    """Keep credentials in temporary files before they are put where a proxy sees them."""
    named = {PurePosixPath(name).name: text for name, text in files.items()}
    made = folder / "claiming"
    shutil.rmtree(made, ignore_errors=True)  # left by a `join` that was killed
    disk.make_folder(made)
    try:
        place = CredentialPaths.of(made, holder.role.value)
        for path in (place.ca, place.certificate, place.key):
            disk.write_whole(path, named.get(path.name, ""))
        yield place
    finally:
        shutil.rmtree(made)


def read(file: Path) -> bytes:
    """Return a bundle's bytes."""
    try:
        with file.open("rb") as opened:
            return opened.read(bundle.SIZE_LIMIT + 1)
    except OSError as error:
        raise CredentialError(
            f"the bundle `{file}` cannot be read: {error.strerror}",
            "a bundle can be used only once, and is then deleted",
        ) from None


def check_name(name: str, depth: int = 2) -> None:
    """Check that a file name stays below its folder."""
    parts = PurePosixPath(name).parts
    safe = parts and all(part.strip(".") and "\0" not in part for part in parts)
    if not safe or len(parts) > depth or name.startswith("/") or "/".join(parts) != name:
        raise ValueError(f"a file with an unexpected name: {name!r:.60}")


@dataclass(frozen=True)
class Content:
    """The content of a bundle: files with expected names, and the rendezvous endpoints."""

    files: Mapping[Annotated[str, only(_BROUGHT.fullmatch, "a file of a bundle")], str]
    rendezvous: tuple[Endpoint, ...] = ()


def read_content(content: Any) -> Content:
    """Return the content of a bundle."""
    try:
        made = from_plain(Content, content)
        for name, text in made.files.items():
            if name.endswith(".yaml"):
                _check_paths(plain(yaml_tree.tree(text, name)))
    except (ValueError, SpecError) as error:
        raise CredentialError(f"the bundle's content is invalid: {error}") from error
    return made


def _check_paths(config: Any) -> None:
    """Check that a proxy will not read or write outside its folder. Raises ValueError."""
    keys = ("membership", "status", "lock", "records", "announcements")
    held = config if isinstance(config, dict) else {}
    credentials = held.get("credentials")
    paths = [held.get(key) for key in keys]
    paths += credentials.values() if isinstance(credentials, dict) else ()
    for path in paths:
        if isinstance(path, str):
            check_name(path)


def destroy(file: Path) -> None:
    """Delete a used bundle."""
    try:
        file.unlink()
    except OSError as error:
        raise FogftError(
            f"the machine has joined, but `{file}` cannot be removed: {error.strerror}",
            "remove it by hand: it cannot be used again",
        ) from None
