"""A small private certificate authority, for mutual TLS between the programs of one site.

A sound example, not a replacement for a company's existing authority: any authority works whose certificates have the
common names of the access rules.
"""

from __future__ import annotations

import datetime
import ipaddress
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

_CA_DAYS = 3650
_DAYS = 825
_EARLIER = datetime.timedelta(hours=1)  # for clocks that are behind


class Authority:
    """The authority whose key and certificate are in a folder; created there if there is none."""

    def __init__(self, folder: Path) -> None:
        """Raises OSError for a folder that can't be written to, ValueError for files that aren't an authority's."""
        self._folder = folder
        key_path, path = folder / "ca-key.pem", folder / "ca.pem"
        self.is_new = _is_missing(path, key_path)
        if self.is_new:
            self._key = ec.generate_private_key(ec.SECP256R1())
            self._certificate = _signed(
                _builder("gripmon private authority", self._key, _CA_DAYS, ca=True), self._key, issuer=None
            )
            _write(key_path, _private_pem(self._key), secret=True)
            _write(path, self._certificate.public_bytes(serialization.Encoding.PEM))
        else:
            try:
                key = serialization.load_pem_private_key(key_path.read_bytes(), password=None)
                self._certificate = x509.load_pem_x509_certificate(path.read_bytes())
            except (ValueError, TypeError) as error:
                raise ValueError(f"{folder}: ca.pem or ca-key.pem can't be read: {error}") from error
            if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != self._certificate.public_key():
                raise ValueError(f"{folder}: ca-key.pem doesn't belong to ca.pem")
            self._key = key

    def issue(self, name: str, hosts: Sequence[str] = ()) -> bool:
        """Make ``<name>.pem`` and ``<name>-key.pem`` (mode 0600) with the common name ``name``; False if they exist.
        Raises ValueError if only one of them exists.

        With ``hosts``, names or addresses at which it is reached, it may also be used by a server.
        """
        key_path, path = self._folder / f"{name}-key.pem", self._folder / f"{name}.pem"
        if not _is_missing(path, key_path):
            return False
        key = ec.generate_private_key(ec.SECP256R1())
        builder = _builder(name, key, _DAYS, ca=False, hosts=hosts)
        certificate = _signed(builder, self._key, issuer=self._certificate)
        _write(key_path, _private_pem(key), secret=True)
        _write(path, certificate.public_bytes(serialization.Encoding.PEM))
        return True


@dataclass(frozen=True)
class Issued:
    """A certificate's content: common name, whether a server may use it, and for which hosts."""

    name: str
    serves: bool
    hosts: tuple[str, ...]


def read(path: Path) -> Issued:
    """Read a certificate.  Raises ValueError for a file that isn't one, OSError for one that can't be read."""
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
        names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        found = {type(each.value): each.value for each in certificate.extensions}
    except (ValueError, x509.DuplicateExtension) as error:
        raise ValueError(f"{path} is not a certificate: {error}; delete it and its key for new ones") from error
    uses = found.get(x509.ExtendedKeyUsage, ())
    alternatives = found.get(x509.SubjectAlternativeName, ())
    hosts = [str(each.value) for each in alternatives if isinstance(each, (x509.DNSName, x509.IPAddress))]
    return Issued(
        name=str(names[0].value) if names else "",
        serves=ExtendedKeyUsageOID.SERVER_AUTH in uses,
        hosts=tuple(hosts),
    )


def _is_missing(certificate: Path, key: Path) -> bool:
    """Whether neither exists.  Raises ValueError if only one of them does."""
    there = [path for path in (certificate, key) if path.exists()]
    if len(there) == 1:
        missing = key if there[0] == certificate else certificate
        raise ValueError(f"{missing} is missing, but {there[0].name} is there; both, or neither for new ones")
    return not there


def _builder(
    name: str, key: ec.EllipticCurvePrivateKey, days: int, *, ca: bool, hosts: Iterable[str] = ()
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLIER)
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=ca, path_length=0 if ca else None), critical=True)
        .add_extension(_usage(ca=ca), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    if ca:
        return builder
    # Every certificate has a name, since some implementations require one; another extension allows serving.
    alternatives = [_alternative(host) for host in hosts] or [x509.DNSName(f"{name}.invalid")]
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
    return builder.add_extension(x509.SubjectAlternativeName(alternatives), critical=False).add_extension(
        x509.ExtendedKeyUsage(uses), critical=False
    )


def _signed(
    builder: x509.CertificateBuilder, key: ec.EllipticCurvePrivateKey, *, issuer: x509.Certificate | None
) -> x509.Certificate:
    if issuer is None:
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "gripmon private authority")])
        return builder.issuer_name(name).sign(key, hashes.SHA256())
    identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(key.public_key())
    return builder.issuer_name(issuer.subject).add_extension(identifier, critical=False).sign(key, hashes.SHA256())


def _usage(*, ca: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not ca,
        key_cert_sign=ca,
        crl_sign=ca,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _private_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write(path: Path, data: bytes, *, secret: bool = False) -> None:
    """Write a new file; never replaces one, and a secret is never readable by others, not even for a moment."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600 if secret else 0o644)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
