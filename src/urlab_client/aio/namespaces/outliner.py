"""`client.outliner`: inspecting the world."""

from __future__ import annotations

from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.namespaces._base import fill
from urlab_client.aio.namespaces._ops import OutlinerOps
from urlab_client.protocol.messages.outliner import ActorRow, FindActors, ListActors
from urlab_client.values.scene_types import ActorInfo

_LIGHTS = frozenset({"DirectionalLight", "PointLight", "SpotLight", "RectLight", "SkyLight"})


class OutlinerNamespace(OutlinerOps):
    """Inspecting the world, and preparing plain meshes for physics."""

    async def list_actors(self, *, timeout: Timeout = DEFAULT) -> list[ActorInfo]:
        """List the visible actors of the edited level.

        Raises:
            ListActorsFailed: There is no world to list.
        """
        return [_info(row) for row in (await self._call(ListActors(), timeout)).actors]

    async def find_actors(
        self,
        *,
        class_filter: str | None = None,
        tag: str | None = None,
        name_prefix: str | None = None,
        in_pie: bool = False,
        timeout: Timeout = DEFAULT,
    ) -> list[ActorInfo]:
        """List the actors that pass every given filter.

        The plugin does not send the kind of an actor here. The client derives it from the class name, and
        `has_quick_convert` stays False.

        Args:
            class_filter: Class or parent class name, any letter case.
            tag: Whole tag, any letter case.
            name_prefix: Beginning of the engine actor name, any letter case.
            in_pie: Search the play world if play is running.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            FindActorsFailed: There is no world to search.
        """
        request = FindActors(class_filter=class_filter, tag=tag, name_prefix=name_prefix, in_pie=in_pie)
        return [_info(row) for row in (await self._call(request, timeout)).actors]


def _info(row: ActorRow) -> ActorInfo:
    kind = row.actor_class
    return fill(
        ActorInfo,
        row,
        *([] if row.quick_convert is None else [row.quick_convert]),
        is_articulation=_given(row.is_articulation, kind.endswith("_C") or kind == "MjArticulation"),
        has_quick_convert=_given(row.has_quick_convert, False),
        is_static_mesh_actor=_given(row.is_static_mesh_actor, kind == "StaticMeshActor"),
        is_light=_given(row.is_light, kind in _LIGHTS),
        tags=tuple(row.tags or ()),
    )


def _given(sent: bool | None, derived: bool) -> bool:
    return derived if sent is None else sent
