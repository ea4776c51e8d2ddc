"""Member list of a simulated fleet, shared in memory."""

import hashlib
from collections.abc import Callable
from dataclasses import replace

from edge.identity.guard import Membership, SignedGuard
from edge.identity.members import Member, Members, Role
from edge.identity.signature import Signer


class SimulatedMembers:
    """Members with keys derived from their names, so that flights repeat.

    Every guard gets a changed `list` at once.
    """

    def __init__(self, fleet: str) -> None:
        self._fleet = fleet
        self.list = Members(fleet, 1, self._signer("authority").public_key)
        # Includes revoked members, which must not rejoin by a restart.
        self._joined: list[Member] = []
        self._guards: list[SignedGuard] = []

    def guard(
        self,
        role: Role,
        name: str,
        robot_id: int | None,
        start: int,
        clock_s: Callable[[], float],
    ) -> SignedGuard:
        """Guard for one start of a member's program; a new member joins the list."""
        signer = self._signer(f"{role} {name}")
        own = Member(role, name, robot_id, signer.public_key)
        if own not in self._joined:
            self._joined.append(own)
            self._change((*self.list.members, own))
        guard = SignedGuard(Membership(own, signer, self.list, start), clock_s)
        self._guards.append(guard)
        return guard

    def revoke(self, role: Role, name: str) -> None:
        """Remove a member from the list."""
        key = self._signer(f"{role} {name}").public_key
        self._change(tuple(m for m in self.list.members if m.public_key != key))

    def _change(self, members: tuple[Member, ...]) -> None:
        self.list = replace(self.list, number=self.list.number + 1, members=members)
        for guard in self._guards:
            guard.update_members(self.list)

    def _signer(self, owner: str) -> Signer:
        return Signer(hashlib.sha256(f"{self._fleet} {owner}".encode()).digest())
