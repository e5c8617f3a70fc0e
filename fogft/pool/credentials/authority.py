"""A pool's certificate authority and the certificates that it issues.

A certificate names its holder (common name) and limits what it may be used for: a robot's is valid
for TLS clients only, a replica's for TLS servers only. TLS itself checks this (extended key usage).
Unusable files raise `CredentialError`, files that cannot be written `StateError`.

Not here: who gets one (`fogft.pool`), how they are used (`fogft.link.zenoh.settings`).
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from fogft import disk
from fogft.errors import CredentialError
from fogft.model.credentials import Role, holder_of
from fogft.model.plain import utc
from fogft.records.signing import Signer, attribute

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

AUTHORITY_CERTIFICATE = "ca.crt"
AUTHORITY_KEY = "ca.key"
# A dead manager renews nothing, and must not stop traffic: a leaf outlasts any repair.
LEAF_DAYS = 365.0
RENEW_BEFORE = datetime.timedelta(days=60)
# Clocks may be wrong, and set later: no certificate is "not valid yet", and the CA never expires.
BEGIN = datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
NEVER = datetime.datetime(9999, 12, 31, 23, 59, 59, tzinfo=datetime.timezone.utc)


@dataclass(frozen=True)
class Credential:
    """A certificate with its key, and the CA that both ends trust; all PEM."""

    certificate_pem: bytes
    key_pem: bytes = field(repr=False)
    authority_pem: bytes = field(repr=False)

    def files(self, stem: str) -> dict[str, bytes]:
        """Return its files by name: ``ca.crt``, ``<stem>.key`` and, last, ``<stem>.crt``."""
        pair = {f"{stem}.key": self.key_pem, f"{stem}.crt": self.certificate_pem}
        return {AUTHORITY_CERTIFICATE: self.authority_pem, **pair}


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
            return f"not valid before {utc(self.not_before.timestamp())}"
        if now >= self.not_after:
            return f"expired at {utc(self.not_after.timestamp())}"
        return ""


def create_authority(folder: Path, pool_uid: str) -> None:
    """Create the pool's CA in a folder, which is created too. An existing CA is kept."""
    if (folder / AUTHORITY_CERTIFICATE).exists():
        _load_authority(folder)
        return
    disk.make_folder(folder)
    certificate, key = _made(f"fogft.{pool_uid}", role=None, not_after=NEVER, issuer=None)
    # The key first: a crash in between leaves no certificate, so the next call begins again.
    disk.write_whole(folder / AUTHORITY_KEY, key)
    disk.write_whole(folder / AUTHORITY_CERTIFICATE, certificate)


def issue(folder: Path, common_name: str, *, role: Role, days: float = LEAF_DAYS) -> Credential:
    """Certify a new key under a name of 1 to 64 characters, for `days` or until the CA expires."""
    issuer, now = _load_authority(folder), datetime.datetime.now(datetime.timezone.utc)
    if issuer[0].not_valid_after_utc <= now:
        raise CredentialError(
            f"the pool's CA expired at {issuer[0].not_valid_after_utc:%Y-%m-%d}",
            "set the clock, or recreate the pool with `fogft down`, then `fogft up`",
        )
    not_after = min(now + datetime.timedelta(days=days), issuer[0].not_valid_after_utc)
    certificate, key = _made(common_name, role=role, not_after=not_after, issuer=issuer)
    return Credential(certificate, key, (folder / AUTHORITY_CERTIFICATE).read_bytes())


def write(credential: Credential, folder: Path, stem: str) -> None:
    """Write its files to a folder (0700), each 0600."""
    disk.make_folder(folder)
    disk.write_together({folder / name: data for name, data in credential.files(stem).items()})


def describe(path: Path) -> Description:
    """Return the fields of a certificate file."""
    return _described(_load_certificate(path))


def is_good(path: Path, now: datetime.datetime, revoked: frozenset[str] = frozenset()) -> bool:
    """Whether a certificate exists with its key, is not revoked, and valid for two more months."""
    try:
        said = describe(path)
        holder_of(said.common_name)
        Signer(path, path.with_suffix(".key"))
    except (CredentialError, ValueError):
        return False  # there is none yet, it is damaged, or of another form
    problem = said.problem(now) or said.problem(now + RENEW_BEFORE)
    return said.common_name not in revoked and not problem


def describe_pem(pem: bytes) -> Description:
    """Return the fields of a PEM certificate."""
    from cryptography import x509

    return _described(x509.load_pem_x509_certificate(pem))


def _described(certificate: x509.Certificate) -> Description:
    return Description(
        common_name=attribute(certificate, "CN"),
        role=attribute(certificate, "OU"),
        serial=f"{certificate.serial_number:x}",
        not_before=certificate.not_valid_before_utc,
        not_after=certificate.not_valid_after_utc,
    )


def _made(
    common_name: str,
    *,
    role: Role | None,
    not_after: datetime.datetime,
    issuer: tuple[x509.Certificate, ec.EllipticCurvePrivateKey] | None,
) -> tuple[bytes, bytes]:
    """Make a certificate and its key, both PEM; the CA's own if role and issuer are None."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID

    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name(
        [
            x509.NameAttribute(x509.NameOID.ORGANIZATIONAL_UNIT_NAME, role.value if role else "ca"),
            x509.NameAttribute(x509.NameOID.COMMON_NAME, common_name),
        ]
    )
    signer, issued_by = key, subject
    if issuer is not None:
        signer, issued_by = issuer[1], issuer[0].subject
    identifier = x509.SubjectKeyIdentifier.from_public_key(signer.public_key())
    usage = x509.KeyUsage(
        digital_signature=role is not None,
        key_cert_sign=role is None,
        crl_sign=role is None,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issued_by)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(BEGIN)
        .not_valid_after(not_after)
        .add_extension(x509.BasicConstraints(ca=role is None, path_length=None), critical=True)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(identifier),
            critical=False,
        )
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(usage, critical=True)
    )
    if role is not None:
        asks, answers = ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH
        usages = {
            Role.ROBOT: [asks],
            Role.REPLICA: [answers],
            Role.GATEWAY: [answers, asks],
            Role.RENDEZVOUS: [answers],
            # Valid for no connection at all: neither end of TLS accepts it.
            Role.MANAGER: [ExtendedKeyUsageOID.CODE_SIGNING],
        }
        builder = builder.add_extension(
            x509.SubjectAlternativeName([x509.DNSName(common_name)]), critical=False
        ).add_extension(x509.ExtendedKeyUsage(usages[role]), critical=True)
    pem = serialization.Encoding.PEM
    form, encryption = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    signed = builder.sign(signer, hashes.SHA256())
    return signed.public_bytes(pem), key.private_bytes(pem, form, encryption)


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
