"""The members of a simulated fleet: its authority, and whoever that gave a card."""

import hashlib
from collections.abc import Callable

from edge.identity.card import Card, Revocations, Role, signed
from edge.identity.guard import Membership, SignedGuard
from edge.identity.signature import Signer

# No simulated card expires.
_EXPIRES_UNIX_S = 1e11


class SimulatedMembers:
    """An authority in memory. Its keys follow from its name, so that flights can be repeated."""

    def __init__(self, fleet: str) -> None:
        self._fleet = fleet
        self.authority = self._signer("authority")
        self._cards: dict[tuple[Role, str], bytes] = {}
        self._revocations = 0

    def join(self, role: Role, name: str, robot_id: int | None, start: int) -> Membership:
        """One start of a member's program; its key and its card are the same each time."""
        signer, serial = self._signer(f"{role} {name}"), len(self._cards) + 1
        card = Card(self._fleet, role, name, signer.public_key, serial, _EXPIRES_UNIX_S, robot_id)
        card_data = self._cards.setdefault((role, name), signed(card, self.authority))
        return Membership(self.authority.public_key, signer, card_data, start)

    def guard(
        self,
        role: Role,
        name: str,
        robot_id: int | None,
        start: int,
        clock_s: Callable[[], float],
    ) -> SignedGuard:
        """Guard that the member speaks and hears through."""
        return SignedGuard(self.join(role, name, robot_id, start), clock_s)

    def revoke(self, role: Role, name: str) -> bytes:
        """A signed list with that member's key alone."""
        self._revocations += 1
        fingerprint = self._signer(f"{role} {name}").fingerprint.hex()
        return signed(Revocations(self._revocations, (fingerprint,)), self.authority)

    def _signer(self, whose: str) -> Signer:
        return Signer(hashlib.sha256(f"{self._fleet} {whose}".encode()).digest())
