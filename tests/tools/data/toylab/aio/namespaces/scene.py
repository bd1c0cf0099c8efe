"""Scene ops written by hand."""

from __future__ import annotations

from toylab.aio.namespaces._ops import SceneOps
from toylab.aio.robots import Body


class Scene(SceneOps):
    """The scene."""

    async def spawn(self, names: list[str]) -> dict[str, Body]:
        """Spawn bodies."""
        return {name: Body(self._session, name) for name in names}
