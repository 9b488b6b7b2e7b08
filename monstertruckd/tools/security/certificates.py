"""X.509 certificates of P-256 keys (RFC 5280, RFC 5480): authorities and issued certificates.

Every station has its own issuer, certified by the authority. A robot that trusts the issuers of its stations,
and not the authority, admits no other station: another certificate of the authority does not even open a link.
"""

import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import contents, reading
from monstertruck_runtime.small_files import MEGABYTE, replace_file

DAY: Final = 86_400


@dataclass(frozen=True, slots=True)
class Certificate:
    """A certificate with its key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @property
    def pem(self) -> bytes:
        """The certificate as PEM."""
        return self.certificate.public_bytes(serialization.Encoding.PEM)

    @property
    def key_pem(self) -> bytes:
        """The key as PEM, unencrypted: every reader of the file has it."""
        return self.key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )

    def save(self, certificate: Path, key: Path, *chain: bytes) -> None:
        """Write both files, the certificate followed by its issuers' certificates.

        Raises:
            OSError: one cannot be written.
        """
        if key.exists():
            key.chmod(0o600)  # a file that is replaced keeps its mode
        replace_file(key, self.key_pem, 0o600)
        replace_file(certificate, b"".join((self.pem, *chain)))


def load(certificate: Path, key: Path) -> Certificate:
    """Read both files.

    Raises:
        InputError: one is missing, or no certificate or key of this kind.
    """
    loaded = read_certificate(certificate)
    with reading(key, "a private key"):
        private = serialization.load_pem_private_key(contents(key, "a private key", MEGABYTE), None)
    if not isinstance(private, ec.EllipticCurvePrivateKey):
        raise InputError(f"{key}: expected a key of an elliptic curve")
    return Certificate(loaded, private)


def read_certificate(path: Path) -> x509.Certificate:
    """The first certificate of a file.

    Raises:
        InputError: there is none.
    """
    return read_certificates(path)[0]


def read_certificates(path: Path) -> list[x509.Certificate]:
    """All certificates of a file.

    Raises:
        InputError: there is none, or one is damaged.
    """
    with reading(path, "a certificate"):
        return x509.load_pem_x509_certificates(contents(path, "a certificate", MEGABYTE))


def common_name(certificate: x509.Certificate) -> str:
    """Return the common name of a certificate, or its whole subject without one."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else certificate.subject.rfc4514_string()


def seconds_left(certificate: x509.Certificate, now: int) -> int:
    """Return the seconds until a certificate expires.

    Args:
        certificate: certificate to examine.
        now: real time (s).
    """
    return round(certificate.not_valid_after_utc.timestamp()) - now


def began(certificate: x509.Certificate) -> int:
    """Return the start of a certificate's validity, real time (s)."""
    return round(certificate.not_valid_before_utc.timestamp())


def new_authority(name: str, now: int, days: int) -> Certificate:
    """Create a self-signed authority.

    Args:
        name: common name.
        now: real time (s).
        days: validity.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _name(name)
    return Certificate(_authority(_builder(subject, subject, key, now, days * DAY), key, None), key)


def new_issuer(authority: Certificate, name: str, now: int, days: int) -> Certificate:
    """Create an authority below ``authority`` that may only certify end entities."""
    key = ec.generate_private_key(ec.SECP256R1())
    builder = _builder(_name(name), authority.certificate.subject, key, now, days * DAY)
    return Certificate(_authority(builder, authority.key, 0), key)


def issue(issuer: Certificate, name: str, now: int, seconds: int, *, server: Sequence[str] = ()) -> Certificate:
    """Create a certificate of a station, or of a robot that accepts connections.

    Args:
        issuer: signing authority.
        name: common name.
        now: real time (s).
        seconds: validity (s).
        server: addresses and host names used by stations; none for a station.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if server else [])]
    names = [_general_name(address) for address in server or (name,)]
    builder = (
        _builder(_name(name), issuer.certificate.subject, key, now, seconds)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(digital_signature=True), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
    )
    return Certificate(builder.sign(issuer.key, hashes.SHA256()), key)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, now: int, seconds: int
) -> x509.CertificateBuilder:
    # 300: start of a certificate's validity before now, s: computers without a real-time clock run late
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(_date(now - 300))
        .not_valid_after(_date(now + seconds))
    )


def _authority(
    builder: x509.CertificateBuilder, key: ec.EllipticCurvePrivateKey, below: int | None
) -> x509.Certificate:
    return (
        builder.add_extension(x509.BasicConstraints(ca=True, path_length=below), critical=True)
        .add_extension(_usage(key_cert_sign=True, crl_sign=True), critical=True)
        .sign(key, hashes.SHA256())
    )


def _usage(*, digital_signature: bool = False, key_cert_sign: bool = False, crl_sign: bool = False) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=digital_signature,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=key_cert_sign,
        crl_sign=crl_sign,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _general_name(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        return x509.DNSName(address)


def _date(seconds: int) -> Any:
    """Convert to the library's UTC date."""
    return np.datetime64(seconds, "s").item()
