"""A pool's certificate authority and the certificates that it issues.

Each pool has a CA of its own, made at the first `up`; both ends of every link trust it and
nothing else. A certificate says who its holder is (common name, from `model.names`) and what
it may do: a robot's is good for asking only, a replica's for answering only. That is the
extended key usage, which TLS itself checks, so a stolen replica's key can ask nothing.

What cannot be used raises `CredentialError`, what cannot be written `StateError`.

Owns: making, writing, reading and describing keys and certificates. Keys are never shown.
Not here: who gets one (`fogft.pool`), how they are used (`fogft.link.zenoh.settings`).
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fogft import disk
from fogft.errors import CredentialError
from fogft.model.credentials import Role

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

AUTHORITY_CERTIFICATE = "ca.crt"
AUTHORITY_KEY = "ca.key"
AUTHORITY_DAYS = 3650.0
# A dead manager renews nothing, and must stop no traffic: a leaf outlives any repair.
LEAF_DAYS = 365.0
RENEW_BEFORE = datetime.timedelta(days=60)
# Robots' clocks are wrong; a certificate that begins tomorrow, by their clock, is refused.
BACKDATE = datetime.timedelta(hours=24)
_COMMON_NAME_LIMIT = 64  # X.520's upper bound


@dataclass(frozen=True)
class Credential:
    """A certificate with its key, and the CA that both ends trust; all PEM."""

    certificate_pem: bytes
    key_pem: bytes
    authority_pem: bytes

    def __repr__(self) -> str:
        return f"Credential(certificate_pem={self.certificate_pem!r}, key_pem=<hidden>)"


@dataclass(frozen=True)
class Description:
    """The fields of a certificate, for people. Times are in UTC; the serial is hexadecimal."""

    common_name: str
    role: str
    serial: str
    not_before: datetime.datetime
    not_after: datetime.datetime

    def problem(self, now: datetime.datetime) -> str:
        """Return the problem with its validity at `now`, or an empty text."""
        if now < self.not_before:
            return f"not valid before {self.not_before:%Y-%m-%d %H:%M} UTC"
        if now >= self.not_after:
            return f"expired at {self.not_after:%Y-%m-%d %H:%M} UTC"
        return ""


def create_authority(folder: Path, pool_uid: str) -> None:
    """Create the pool's CA in a folder, which is created too. An existing CA is kept."""
    from cryptography.hazmat.primitives.asymmetric import ec

    if (folder / AUTHORITY_CERTIFICATE).exists():
        _load_authority(folder)
        return
    disk.make_folder(folder)
    key = ec.generate_private_key(ec.SECP256R1())
    certificate = _sign(
        key, key.public_key(), f"fogft.{pool_uid}", role=None, authority=None, days=AUTHORITY_DAYS
    )
    # The key first: a crash in between leaves no certificate, so the next call begins again.
    disk.write_whole(folder / AUTHORITY_KEY, _key_pem(key))
    disk.write_whole(folder / AUTHORITY_CERTIFICATE, _certificate_pem(certificate))


def issue(folder: Path, common_name: str, *, role: Role, days: float = LEAF_DAYS) -> Credential:
    """Create a key, certified by the folder's CA under a name of 1 to 64 characters.

    Args:
        days: How long it is valid from now; never beyond the CA's own end.
    """
    from cryptography.hazmat.primitives.asymmetric import ec

    if not 0 < len(common_name) <= _COMMON_NAME_LIMIT:
        raise ValueError(f"a common name has 1 to {_COMMON_NAME_LIMIT} characters: {common_name!r}")
    authority, authority_key = _load_authority(folder)
    key = ec.generate_private_key(ec.SECP256R1())
    certificate = _sign(
        authority_key, key.public_key(), common_name, role=role, authority=authority, days=days
    )
    return Credential(
        certificate_pem=_certificate_pem(certificate),
        key_pem=_key_pem(key),
        authority_pem=_certificate_pem(authority),
    )


def write(credential: Credential, folder: Path, stem: str) -> None:
    """Write ``<stem>.key``, ``<stem>.crt`` and ``ca.crt`` to a folder (0700), each 0600.

    The certificate comes last: where it stands, its key does too.
    """
    disk.make_folder(folder)
    disk.write_whole(folder / AUTHORITY_CERTIFICATE, credential.authority_pem)
    disk.write_whole(folder / f"{stem}.key", credential.key_pem)
    disk.write_whole(folder / f"{stem}.crt", credential.certificate_pem)


def describe(path: Path) -> Description:
    """Return the fields of a certificate file."""
    return _described(_load_certificate(path))


def is_good(path: Path, now: datetime.datetime, revoked: frozenset[str] = frozenset()) -> bool:
    """Whether a certificate exists, is not revoked, and is valid for two more months."""
    try:
        said = describe(path)
    except CredentialError:
        return False  # there is none yet, or it is damaged
    return said.common_name not in revoked and not said.problem(now + RENEW_BEFORE)


def describe_pem(pem: bytes) -> Description:
    """Return the fields of a PEM certificate."""
    from cryptography import x509

    try:
        return _described(x509.load_pem_x509_certificate(pem))
    except ValueError as error:
        raise CredentialError("not a certificate") from error


def _described(certificate: x509.Certificate) -> Description:
    from cryptography import x509

    return Description(
        common_name=_name(certificate, x509.NameOID.COMMON_NAME),
        role=_name(certificate, x509.NameOID.ORGANIZATIONAL_UNIT_NAME),
        serial=f"{certificate.serial_number:x}",
        not_before=certificate.not_valid_before_utc,
        not_after=certificate.not_valid_after_utc,
    )


def _sign(
    signer: ec.EllipticCurvePrivateKey,
    public_key: ec.EllipticCurvePublicKey,
    common_name: str,
    *,
    role: Role | None,
    authority: x509.Certificate | None,
    days: float,
) -> x509.Certificate:
    """Make a certificate; of the CA itself where `role` and `authority` are None."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes

    now = datetime.datetime.now(datetime.timezone.utc)
    not_after = now + datetime.timedelta(days=days)
    if authority is not None:
        not_after = min(not_after, authority.not_valid_after_utc)
    subject = x509.Name(
        [
            x509.NameAttribute(x509.NameOID.ORGANIZATIONAL_UNIT_NAME, role.value if role else "ca"),
            x509.NameAttribute(x509.NameOID.COMMON_NAME, common_name),
        ]
    )
    identifier = x509.SubjectKeyIdentifier.from_public_key(signer.public_key())
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(authority.subject if authority is not None else subject)
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - BACKDATE)
        .not_valid_after(not_after)
        .add_extension(x509.BasicConstraints(ca=role is None, path_length=None), critical=True)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(identifier),
            critical=False,
        )
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public_key), critical=False)
        .add_extension(_key_usage(is_authority=role is None), critical=True)
    )
    if role is not None:
        builder = builder.add_extension(
            x509.SubjectAlternativeName([x509.DNSName(common_name)]), critical=False
        ).add_extension(x509.ExtendedKeyUsage(_usages(role)), critical=True)
    return builder.sign(signer, hashes.SHA256())


def _usages(role: Role) -> list[x509.ObjectIdentifier]:
    from cryptography.x509.oid import ExtendedKeyUsageOID

    asks = ExtendedKeyUsageOID.CLIENT_AUTH
    answers = ExtendedKeyUsageOID.SERVER_AUTH
    return {
        Role.ROBOT: [asks],
        Role.REPLICA: [answers],
        Role.GATEWAY: [answers, asks],
        Role.RENDEZVOUS: [answers],
        # Good for no connection at all: neither end of TLS accepts it.
        Role.MANAGER: [ExtendedKeyUsageOID.CODE_SIGNING],
    }[role]


def _key_usage(*, is_authority: bool) -> x509.KeyUsage:
    from cryptography import x509

    return x509.KeyUsage(
        digital_signature=not is_authority,
        key_cert_sign=is_authority,
        crl_sign=is_authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _load_authority(folder: Path) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    certificate = _load_certificate(folder / AUTHORITY_CERTIFICATE)
    path = folder / AUTHORITY_KEY
    try:
        key = load_pem_private_key(path.read_bytes(), password=None)
    except (OSError, ValueError, TypeError) as error:
        raise CredentialError(
            f"the key of the pool's CA, `{path}`, cannot be used: {_reason(error)}",
            "without it no replica can be launched; recreate the pool "
            "with `fogft down`, then `fogft up`",
        ) from None  # the cause could quote the file
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise CredentialError(f"`{path}` is not an EC key")
    if key.public_key() != certificate.public_key():
        raise CredentialError(f"`{path}` does not belong to the certificate beside it")
    return certificate, key


def _load_certificate(path: Path) -> x509.Certificate:
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as error:
        raise CredentialError(
            f"the certificate `{path}` cannot be used: {_reason(error)}",
            "`fogft up` writes the pool's certificates",
        ) from error


def _reason(error: Exception) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else "it is damaged"


def _name(certificate: x509.Certificate, oid: x509.ObjectIdentifier) -> str:
    attributes = certificate.subject.get_attributes_for_oid(oid)
    return str(attributes[0].value) if attributes else ""


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    from cryptography.hazmat.primitives import serialization

    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def _certificate_pem(certificate: x509.Certificate) -> bytes:
    from cryptography.hazmat.primitives import serialization

    return certificate.public_bytes(serialization.Encoding.PEM)
