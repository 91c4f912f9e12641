"""Who belongs to a lab: its own certificate authority, and a certificate with its key for each member.

A member is a folder that can be copied to its machine as it is: ``ca.pem``, ``certificate.pem``, ``key.pem``. Its name
(``runner-alice``) is the certificate's common name, by which the router knows it; what stands before the first hyphen
is its role. Keys are EC P-256; TLS is mutual, so that a certificate alone is worth nothing.
"""

from __future__ import annotations

import datetime
import ipaddress
import os
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from drivers.errors import NotConnected

Role = Literal["router", "device", "runner", "viewer"]
ROLES: tuple[Role, ...] = get_args(Role)

AUTHORITY_DAYS = 3650
MEMBER_DAYS = 365
WARNING_DAYS = 30
"""A certificate that ends sooner than this is worth a warning [days]."""

CA, CERTIFICATE, KEY = "ca.pem", "certificate.pem", "key.pem"

_EARLIER = datetime.timedelta(hours=1)  # certificates begin a little in the past: the lab's clocks differ
_CURVE = ec.SECP256R1


@dataclass(frozen=True)
class Identity:
    """What a process shows to the router, and what it knows the router by: files, checked, and what they say.

    ``expires`` and ``ca_expires`` are aware datetimes in UTC. ``role`` is None for a name of another scheme.
    """

    name: str
    role: Role | None
    ca: Path
    certificate: Path
    key: Path
    expires: datetime.datetime
    ca_expires: datetime.datetime

    @property
    def files(self) -> tuple[Path, Path, Path]:
        """Authority, certificate, key."""
        return self.ca, self.certificate, self.key


def days_left(expires: datetime.datetime) -> int:
    """Whole days until ``expires``; negative once it has passed."""
    return (expires - datetime.datetime.now(datetime.UTC)).days


def role_of(name: str) -> Role | None:
    """The role that a member's name begins with."""
    head = name.split("-", 1)[0]
    return next((role for role in ROLES if role == head), None)


# -- making -----------------------------------------------------------------------------------------------------------


def make_authority(folder: Path, name: str, days: int = AUTHORITY_DAYS) -> None:
    """A new authority in ``folder``: ``ca.pem`` and ``key.pem``. Raises FileExistsError rather than overwrite one."""
    key = ec.generate_private_key(_CURVE())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    certificate = (
        _lasting(days)
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(sign_certificates=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    _write_key(folder / KEY, key)
    _write(folder / CA, certificate.public_bytes(serialization.Encoding.PEM))


def make_member(authority: Path, folder: Path, name: str, hosts: Sequence[str] = (), days: int = MEMBER_DAYS) -> None:
    """A new member of an ``authority`` (its folder) in ``folder``; ``hosts`` are where a router can be reached.

    Raises FileExistsError where a key is there already, NotConnected for an authority whose key is not kept to itself.
    """
    key = ec.generate_private_key(_CURVE())
    use = ExtendedKeyUsageOID.SERVER_AUTH if role_of(name) == "router" else ExtendedKeyUsageOID.CLIENT_AUTH
    builder = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]))
        .public_key(key.public_key())
        .add_extension(x509.ExtendedKeyUsage([use]), critical=False)
        .add_extension(x509.SubjectAlternativeName([_general_name(host) for host in hosts or (name,)]), critical=False)
    )
    signed = _signed(authority, builder, days)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    _write_key(folder / KEY, key)
    _write(folder / CERTIFICATE, signed)
    _write(folder / CA, (authority / CA).read_bytes())


def renew_member(authority: Path, folder: Path, days: int = MEMBER_DAYS) -> None:
    """A new certificate for a member's old key, in place of the old one; needs no private key but the authority's."""
    old = _certificate(folder / CERTIFICATE)
    builder = x509.CertificateBuilder().subject_name(old.subject).public_key(old.public_key())
    for kind in (x509.ExtendedKeyUsage, x509.SubjectAlternativeName):
        builder = builder.add_extension(old.extensions.get_extension_for_class(kind).value, critical=False)
    aside = folder / f".{CERTIFICATE}.new"
    aside.unlink(missing_ok=True)  # of a renewal that was cut off
    _write(aside, _signed(authority, builder, days))
    aside.replace(folder / CERTIFICATE)


def _signed(authority: Path, builder: x509.CertificateBuilder, days: int) -> bytes:
    ca = _certificate(authority / CA)
    key = serialization.load_pem_private_key(_private(authority / KEY), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    issuer = ca.public_key()
    assert isinstance(issuer, ec.EllipticCurvePublicKey)
    certificate = (
        _lasting(days, builder)
        .issuer_name(ca.subject)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(sign_certificates=False), critical=True)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer), critical=False)
        .sign(key, hashes.SHA256())
    )
    return certificate.public_bytes(serialization.Encoding.PEM)


def _lasting(days: int, builder: x509.CertificateBuilder | None = None) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    end = now + datetime.timedelta(days=days)
    return (
        (builder or x509.CertificateBuilder())
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, end) - _EARLIER)
        .not_valid_after(end)
    )


def _usage(sign_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not sign_certificates,
        key_cert_sign=sign_certificates,
        crl_sign=sign_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    plain = serialization.NoEncryption()
    pem = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain)
    _write(path, pem, 0o600)


def _write(path: Path, data: bytes, mode: int = 0o644) -> None:
    """A new file, from the first moment on readable by no one but whom ``mode`` allows."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


# -- reading ----------------------------------------------------------------------------------------------------------


def read_identity(ca: Path, certificate: Path, key: Path) -> Identity:
    """A member's three files, looked through before anybody is asked to believe them.

    Raises NotConnected, with what to do, for a file that is missing or no such thing, a key that others can read or
    that is not the certificate's, a certificate of another authority, one that has expired or is not valid yet.
    """
    authority, own = _certificate(ca), _certificate(certificate)
    pem = _private(key)
    try:
        private = serialization.load_pem_private_key(pem, None)
    except (ValueError, TypeError) as error:
        raise _unusable(
            key, "it is no private key in PEM without a password", "Copy the member's folder anew"
        ) from error
    if private.public_key() != own.public_key():
        raise _unusable(key, f"it is not the key of {certificate}", "Copy the member's folder anew, as a whole")
    try:
        own.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        remedy = f"Put the ca.pem of its own lab beside it, or have this lab make one: `extrinsic lab add` ({ca})"
        raise _unusable(certificate, "another authority signed it", remedy) from error
    for path, known in ((ca, authority), (certificate, own)):
        now, remedy = datetime.datetime.now(datetime.UTC), "Check this machine's clock, or renew it: "
        remedy += "`extrinsic lab init` anew" if path == ca else "`extrinsic lab renew`"
        if now > known.not_valid_after_utc:
            raise _unusable(path, f"it expired at {known.not_valid_after_utc:%Y-%m-%d %H:%M} UTC", remedy)
        if now < known.not_valid_before_utc:
            raise _unusable(path, f"it is valid only from {known.not_valid_before_utc:%Y-%m-%d %H:%M} UTC", remedy)
    name = common_name(own)
    return Identity(name, role_of(name), ca, certificate, key, own.not_valid_after_utc, authority.not_valid_after_utc)


def expiry(certificate: Path) -> tuple[str, datetime.datetime]:
    """Name and end (UTC) of a certificate, valid or not. Raises NotConnected where there is none."""
    found = _certificate(certificate)
    return common_name(found), found.not_valid_after_utc


def common_name(certificate: x509.Certificate) -> str:
    """The name that a certificate is for; empty where it has none."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        raise _unusable(
            path, f"{error.strerror}", "Check bus.tls of the station file; `extrinsic lab` makes them"
        ) from error
    except ValueError as error:
        raise _unusable(path, "it is no certificate in PEM", "Copy the member's folder anew") from error


def _private(path: Path) -> bytes:
    """A private key's bytes. Raises NotConnected where others may read them."""
    try:
        with path.open("rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            if mode & 0o077:
                raise _unusable(path, f"others can read this private key (mode {mode:04o})", f"chmod 600 {path}")
            return file.read()
    except OSError as error:
        raise _unusable(
            path, f"{error.strerror}", "Check bus.tls of the station file; `extrinsic lab` makes them"
        ) from error


def _unusable(path: Path, got: str, remedy: str) -> NotConnected:
    return NotConnected("bus", f"use {path}", got, remedy)
