"""Sign with a certificate's key, and verify signatures: for records and greetings.

A process signs its records with its TLS key: no further keys have to be distributed, and a process
that may not open a link cannot write a record either.

Not here: what may be signed by whom (`fogft.records.record`), making keys (`fogft.pool`).
"""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from fogft import disk
from fogft.errors import CredentialError
from fogft.records.record import RecordError, Writer

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

_KNOWN_LIMIT = 4096


class Signer:
    """Signs with a key on disk; reloads it when its certificate was replaced."""

    def __init__(self, certificate: Path, key: Path) -> None:
        self._certificate_path = certificate
        self._key_path = key
        self._version: tuple[int, int, int] | None = None
        self._der = b""
        self._common_name = ""
        self._key: ec.EllipticCurvePrivateKey | None = None
        self._load()

    @property
    def certificate(self) -> bytes:
        """The current certificate (DER)."""
        self._load()
        return self._der

    @property
    def common_name(self) -> str:
        """The certificate's common name."""
        self._load()
        return self._common_name

    def __call__(self, message: bytes) -> tuple[bytes, bytes]:
        """Return certificate and signature (both DER)."""
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.asymmetric import ec

        self._load()
        assert self._key is not None
        return self._der, self._key.sign(message, ec.ECDSA(hashes.SHA256()))

    def _load(self) -> None:
        version = disk.version(self._certificate_path)
        if version is not None and version == self._version:
            return
        from cryptography import x509
        from cryptography.hazmat.primitives.asymmetric import ec
        from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key

        try:
            certificate = x509.load_pem_x509_certificate(self._certificate_path.read_bytes())
            key = load_pem_private_key(self._key_path.read_bytes(), password=None)
        except (OSError, ValueError, TypeError):
            if self._key is not None:
                return  # it is being replaced: the old pair is still good
            raise CredentialError(
                f"`{self._certificate_path}` or its key cannot be used",
                "`fogft up` writes the pool's certificates",
            ) from None  # the cause could quote the key
        if not isinstance(key, ec.EllipticCurvePrivateKey) or (
            key.public_key() != certificate.public_key()
        ):
            if self._key is not None:
                return
            raise CredentialError(f"`{self._key_path}` does not belong to its certificate")
        self._version, self._der, self._key = version, certificate.public_bytes(Encoding.DER), key
        self._common_name = attribute(certificate, "CN")


class Verifier:
    """Verifies signatures by currently valid certificates of the pool's CA.

    With `any_time`, certificates may have expired: for records verified before. With `lazy`, the CA
    is read on first use; if it cannot be used, that raises `RecordError`.
    """

    def __init__(self, ca: Path, *, any_time: bool = False, lazy: bool = False) -> None:
        self._ca = ca
        self._authorities = [] if lazy else _read_authorities(ca)
        self._any_time = any_time
        self._known: dict[bytes, x509.Certificate] = {}

    def __call__(self, certificate: bytes, signature: bytes, message: bytes) -> Writer:
        """Return who signed `message`. Raises RecordError: certificate or signature is invalid."""
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.asymmetric import ec

        known = self._known.get(certificate) or self._judged(certificate)
        name = attribute(known, "CN")
        now = datetime.datetime.now(datetime.timezone.utc)
        if not self._any_time and now < known.not_valid_before_utc:
            raise RecordError("expired", f"the certificate of `{name}` is not valid yet")
        if not self._any_time and now >= known.not_valid_after_utc:
            raise RecordError("expired", f"the certificate of `{name}` has expired")
        key = known.public_key()
        assert isinstance(key, ec.EllipticCurvePublicKey)  # checked by `_judged`
        try:
            key.verify(signature, message, ec.ECDSA(hashes.SHA256()))
        except InvalidSignature:
            raise RecordError("forged", "a signature that is wrong") from None
        return Writer(attribute(known, "OU"), name)

    def _judged(self, der: bytes) -> x509.Certificate:
        from cryptography import x509
        from cryptography.hazmat.primitives.asymmetric import ec

        try:
            self._authorities = self._authorities or _read_authorities(self._ca)
        except CredentialError as error:
            raise RecordError("authority", error.message) from error
        try:
            certificate = x509.load_der_x509_certificate(der)
            constraints = certificate.extensions.get_extension_for_class(x509.BasicConstraints)
            leaf = not constraints.value.ca
            ours = leaf and isinstance(certificate.public_key(), ec.EllipticCurvePublicKey)
        except Exception as error:  # the parser may raise anything on hostile bytes
            raise RecordError("malformed", "a certificate that cannot be read") from error
        if not ours or not any(_issued(certificate, ca) for ca in self._authorities):
            raise RecordError("authority", "a certificate of another CA")
        if len(self._known) >= _KNOWN_LIMIT:
            self._known.clear()
        self._known[der] = certificate
        return certificate


def _read_authorities(ca: Path) -> list[x509.Certificate]:
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificates(ca.read_bytes())
    except (OSError, ValueError):
        raise CredentialError(f"the CA `{ca}` cannot be used") from None


def _issued(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    from cryptography.exceptions import InvalidSignature

    try:
        certificate.verify_directly_issued_by(authority)
    except (InvalidSignature, ValueError, TypeError):
        return False
    return True


def attribute(certificate: x509.Certificate, which: str) -> str:
    """Return a certificate's common name (``CN``) or unit (``OU``); empty unless there is one."""
    from cryptography import x509

    oids = {"CN": x509.NameOID.COMMON_NAME, "OU": x509.NameOID.ORGANIZATIONAL_UNIT_NAME}
    attributes = certificate.subject.get_attributes_for_oid(oids[which])
    return str(attributes[0].value) if len(attributes) == 1 else ""
