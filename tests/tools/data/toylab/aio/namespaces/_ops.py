"""Generated ops."""

from __future__ import annotations

from toylab.aio.session import Namespace


class SceneOps(Namespace):
    """Ops that follow from their declarations."""

    async def current_level(self) -> str:
        """Return the level's name."""
        await self._session.call("current_level")
        return "lab"
