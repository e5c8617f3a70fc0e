"""A bundle: one file that sets up a robot, gateway, replica or manager on another machine.

It is readable JSON around encrypted content: the key is derived from a passphrase (scrypt), and the
readable part is authenticated as well (AES-GCM). An invalid bundle raises `CredentialError`.

Not here: the content (`joining`), and ensuring that a bundle is used once (`claiming`).
"""

import base64
import hashlib
import json
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from fogft.errors import CredentialError
from fogft.model.credentials import Holder, holder_of
from fogft.model.keys import only
from fogft.model.plain import Moment, from_plain, to_plain, utc

VERSION = 2
SIZE_LIMIT = 32 << 20
PASSPHRASE_LEAST = 12
# 64 MiB and about a fifth of a second per guess. Fixed by the version: a file cannot demand more.
SCRYPT: dict[str, int] = {"n": 1 << 16, "r": 8, "p": 1}
_SCRYPT_MEMORY = 128 << 20
_SALT_BYTES, _NONCE_BYTES = 16, 12
_ALPHABET = "abcdefghjkmnpqrstuvwxyz23456789"  # without characters that look alike


_Name = Annotated[str, only(lambda text: text.isprintable() and 0 < len(text) <= 200, "a name")]


@dataclass(frozen=True)
class Label:
    """The label of a bundle, readable before it is opened. Times in seconds since the epoch."""

    id: _Name
    pool: _Name
    common_name: Annotated[str, holder_of]
    issued_at: Moment
    open_until: Moment

    @property
    def holder(self) -> Holder:
        """The holder that the bundle is for."""
        return holder_of(self.common_name)


def new_passphrase() -> str:
    """Return a passphrase of 98 random bits that is easy to dictate."""
    return "-".join("".join(secrets.choice(_ALPHABET) for _ in range(4)) for _ in range(5))


def check_passphrase(passphrase: str) -> None:
    """Check that a passphrase is long enough."""
    if len(passphrase.strip()) < PASSPHRASE_LEAST:
        raise CredentialError(
            f"the passphrase is shorter than {PASSPHRASE_LEAST} characters",
            "leave the passphrase out to have one generated",
        )


def seal(label: Label, content: Mapping[str, Any], passphrase: str) -> bytes:
    """Return a bundle's bytes."""
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

    check_passphrase(passphrase)
    salt, nonce = secrets.token_bytes(_SALT_BYTES), secrets.token_bytes(_NONCE_BYTES)
    readable = {
        "fogft_bundle": VERSION,
        **to_plain(label),
        "salt": base64.b64encode(salt).decode(),
        "nonce": base64.b64encode(nonce).decode(),
    }
    sealed = AESGCM(_key(passphrase, salt)).encrypt(
        nonce, json.dumps(content).encode(), _canonical(readable)
    )
    whole = {**readable, "sealed": base64.b64encode(sealed).decode()}
    return (json.dumps(whole, indent=1) + "\n").encode()


def read_label(data: bytes) -> Label:
    """Return a bundle's label. It is unverified until the bundle is opened."""
    return _parse(data)[0]


def open_sealed(data: bytes, passphrase: str, now: float) -> tuple[Label, Any]:
    """Return a bundle's label and content; the caller must check the content."""
    from cryptography.exceptions import InvalidTag
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

    label, readable, sealed = _parse(data)
    salt, nonce = _bytes(readable, "salt"), _bytes(readable, "nonce")
    try:
        opened = AESGCM(_key(passphrase, salt)).decrypt(nonce, sealed, _canonical(readable))
        content = json.loads(opened)
    except InvalidTag:
        raise CredentialError(
            "the passphrase is wrong, or the bundle was changed",
            "the command that wrote this file showed the passphrase",
        ) from None
    except ValueError:
        raise CredentialError("the bundle's content is unreadable") from None
    if now >= label.open_until:
        raise CredentialError(
            f"this bundle for `{label.holder.short}` expired at {utc(label.open_until)}",
            f"this machine's clock says {utc(now)}; if that is right, request a new one",
        )
    return label, content


def _parse(data: bytes) -> tuple[Label, dict[str, Any], bytes]:
    try:
        if len(data) > SIZE_LIMIT:
            raise ValueError("it is too large")
        raw = json.loads(data)
        version = raw["fogft_bundle"]
        if type(version) is not int or version != VERSION:
            raise ValueError("it is of another version")
        label = from_plain(Label, raw)
        sealed = _bytes(raw, "sealed")
        if len(_bytes(raw, "salt")) != _SALT_BYTES or len(_bytes(raw, "nonce")) != _NONCE_BYTES:
            raise ValueError("its salt or nonce is of the wrong length")
    except (ValueError, TypeError, KeyError, RecursionError):
        raise CredentialError(
            "this is neither a join bundle nor an exported pool",
            "`fogft credentials issue` writes the former, `fogft export` the latter",
        ) from None
    return label, {key: value for key, value in raw.items() if key != "sealed"}, sealed


def _key(passphrase: str, salt: bytes) -> bytes:
    return hashlib.scrypt(
        passphrase.strip().encode(), salt=salt, dklen=32, maxmem=_SCRYPT_MEMORY, **SCRYPT
    )


def _canonical(readable: Mapping[str, Any]) -> bytes:
    return json.dumps(readable, sort_keys=True, separators=(",", ":")).encode()


def _bytes(raw: Mapping[str, Any], key: str) -> bytes:
    return base64.b64decode(raw.get(key, ""), validate=True)
