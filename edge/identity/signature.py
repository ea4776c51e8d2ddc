"""Ed25519 signatures of messages (RFC 8032).

All are bytes: 32 of a secret key's seed, 32 of a public key, 64 of a signature.
"""

import hashlib

from nacl.bindings import crypto_sign, crypto_sign_open, crypto_sign_seed_keypair
from nacl.exceptions import BadSignatureError

SEED_BYTES = 32
PUBLIC_KEY_BYTES = 32
SIGNATURE_BYTES = 64
FINGERPRINT_BYTES = 8


class Signer:
    """A secret key. Call its methods from any thread."""

    def __init__(self, seed: bytes) -> None:
        """Raises ValueError if the seed is not 32 bytes."""
        if len(seed) != SEED_BYTES:
            raise ValueError(f"a secret key has {len(seed)} bytes: must be {SEED_BYTES}")
        self.public_key, self._secret_key = crypto_sign_seed_keypair(seed)
        self.fingerprint = fingerprint(self.public_key)

    def sign(self, message: bytes) -> bytes:
        """The signature, 64 bytes."""
        return crypto_sign(message, self._secret_key)[:SIGNATURE_BYTES]


def is_signed(message: bytes, signature: bytes, public_key: bytes) -> bool:
    """Whether the key's owner signed the message. Raises nothing, whatever the bytes."""
    try:
        crypto_sign_open(signature + message, public_key)
    except (BadSignatureError, ValueError):
        return False
    return True


def fingerprint(public_key: bytes) -> bytes:
    """Fingerprint of a key: the first 8 bytes of its SHA-256.

    Nobody can find a second key with a member's fingerprint; signatures are verified with the whole
    key.
    """
    return hashlib.sha256(public_key).digest()[:FINGERPRINT_BYTES]
