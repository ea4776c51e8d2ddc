"""A session without SSH: the agent's calls are made in this process."""

from typing import Any

from lpac.fleet import agent
from lpac.fleet.session import RemoteError, Session


class LocalSession(Session):
    """Session whose robot is this process."""

    def __init__(self) -> None:
        """No process: nothing is to be closed."""

    async def call(self, function: str, **arguments: object) -> dict[str, Any]:
        try:
            return agent._CALLS[function](**arguments)
        except agent.Refused as error:
            raise RemoteError(str(error)) from None
