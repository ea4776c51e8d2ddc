"""TLS certificate for the live map.

Browsers do not support Ed25519, so the map has an authority with a key of its own, which nothing
else relies on. Its certificate is imported once in each browser. It is constrained to addresses of
private networks, which limits what a stolen key is worth.
"""

import datetime
import ipaddress
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID

from lpac.fleet.authority import Authority, AuthorityError, private_pem, write_file, x509_name

_KEY, _CERTIFICATE = "web-authority.key", "web-authority.pem"
_MAP_KEY, _MAP_CERTIFICATE = "map.key", "map.pem"
_NETWORKS = tuple(
    map(
        ipaddress.ip_network,
        ("127.0.0.0/8", "10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "169.254.0.0/16",
         "::1/128", "fc00::/7", "fe80::/10"),
    )
)  # fmt: skip
_SIGNS_CERTIFICATES = x509.KeyUsage(
    digital_signature=False, content_commitment=False, key_encipherment=False,
    data_encipherment=False, key_agreement=False, key_cert_sign=True, crl_sign=False,
    encipher_only=False, decipher_only=False,
)  # fmt: skip
_DAY = datetime.timedelta(days=1)
# Some browsers accept no longer validity.
_MAP_VALID = 397 * _DAY
_AUTHORITY_VALID = 3650 * _DAY


class WebCertificate(NamedTuple):
    """PEM files: the authority's certificate for browsers, the server's certificate and key."""

    authority: Path
    certificate: Path
    key: Path


def web_certificate(
    authority: Authority, addresses: Sequence[str], now: datetime.datetime
) -> WebCertificate:
    """Make a certificate for a server at these IP addresses, in the authority's folder.

    Raises AuthorityError for an address that is not of a private network.
    """
    found = [ipaddress.ip_address(address) for address in addresses]
    for address in found:
        if not any(address in network for network in _NETWORKS):
            raise AuthorityError(f"{address}: --tls needs addresses of private networks")
    folder = authority.folder
    if not (folder / _CERTIFICATE).exists():
        _make_authority(authority, now)
    issuer = x509.load_pem_x509_certificate((folder / _CERTIFICATE).read_bytes())
    issuer_key = serialization.load_pem_private_key((folder / _KEY).read_bytes(), None)
    assert isinstance(issuer_key, ec.EllipticCurvePrivateKey)
    key = ec.generate_private_key(ec.SECP256R1())
    names = x509.SubjectAlternativeName([x509.IPAddress(address) for address in found])
    certificate = (
        _unsigned(_name(authority, "map"), issuer.subject, key, now, _MAP_VALID)
        .add_extension(x509.BasicConstraints(False, None), True)
        .add_extension(names, False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key()), False
        )
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), False)
        .sign(issuer_key, hashes.SHA256())
    )
    files = WebCertificate(folder / _CERTIFICATE, folder / _MAP_CERTIFICATE, folder / _MAP_KEY)
    write_file(files.key, private_pem(key), 0o600)
    write_file(files.certificate, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
    return files


def _make_authority(authority: Authority, now: datetime.datetime) -> None:
    key, name = ec.generate_private_key(ec.SECP256R1()), _name(authority, "web authority")
    certificate = (
        _unsigned(name, name, key, now, _AUTHORITY_VALID)
        .add_extension(x509.BasicConstraints(True, 0), True)
        .add_extension(_SIGNS_CERTIFICATES, True)
        .add_extension(
            # Without a permitted name, all names would be permitted.
            x509.NameConstraints(
                [*map(x509.IPAddress, _NETWORKS), x509.DNSName("lpac.invalid")], None
            ),
            True,
        )
        .sign(key, hashes.SHA256())
    )
    write_file(authority.folder / _KEY, private_pem(key), 0o600)
    data = certificate.public_bytes(serialization.Encoding.PEM)
    write_file(authority.folder / _CERTIFICATE, data, 0o644)


def _name(authority: Authority, name: str) -> x509.Name:
    return x509_name(authority.fleet, f"{authority.fleet}: {name}")


def _unsigned(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    now: datetime.datetime,
    valid: datetime.timedelta,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        # A tablet's clock may be slow.
        .not_valid_before(now - _DAY)
        .not_valid_after(now - _DAY + valid)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), False)
    )
