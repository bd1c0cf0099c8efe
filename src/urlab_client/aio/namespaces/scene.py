"""`client.scene`: editor-time authoring of levels and actors."""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Iterable
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, TypeVar

import anyio

from urlab_client.aio.arguments import finite, require
from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.model.upload import flatten, upload
from urlab_client.aio.namespaces._base import Vector, as_quat, as_vec3, fill, target_by
from urlab_client.aio.namespaces._ops import SceneOps
from urlab_client.aio.namespaces.sim import SimNamespace
from urlab_client.aio.session.session import Session
from urlab_client.enums import PIEState
from urlab_client.errors import CreateLevelFailed, ImportFailed, UnknownOp
from urlab_client.protocol.base import Reply
from urlab_client.protocol.messages.outliner import ListActors
from urlab_client.protocol.messages.scene import (
    CreateLevel,
    DestroyActor,
    DuplicateActor,
    ImportXml,
    RemoveActor,
    Snapshot,
    SnapshotRow,
    SpawnActor,
    SpawnGrid,
    SpawnLight,
)
from urlab_client.values.rotation import IDENTITY, euler_to_quat
from urlab_client.values.scene_types import (
    SceneActor,
    SceneSnapshot,
    URLabAsset,
    URLabBlueprint,
    URLabLightHandle,
    URLabSpawnHandle,
)
from urlab_client.values.types import JobStatus, UploadProgress

if TYPE_CHECKING:
    import mujoco

R = TypeVar("R", bound=Reply)


class SceneEdit:
    """Edits of the level, after which play is restarted once; see `client.scene.edit()`."""

    def __init__(self, begin: Callable[[], None], end: Callable[[bool], Awaitable[None]]) -> None:
        """Create the context manager. Nothing is sent before its end.

        Args:
            begin: Callback invoked when the block is entered.
            end: Callback invoked when the block is left, with True unless it raised.
        """
        self._begin = begin
        self._end = end

    async def __aenter__(self) -> None:
        self._begin()

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if isinstance(exc, Exception):
            exc.add_note("scene.edit(): the edits made before this error stay in the level; play was not restarted.")
        await self._end(exc is None)


class SceneNamespace(SceneOps):
    """Editor-time authoring. Edits during play take effect at the next start of play."""

    def __init__(self, session: Session, sim: SimNamespace) -> None:
        super().__init__(session)
        self._sim = sim
        self._edits = 0  # open blocks of `edit()`

    def edit(self, *, timeout_s: float = 30.0) -> SceneEdit:
        """Edit the level in a `with` block, and restart play once at its end, so that the simulation has the edits.

        If play is off at the end, it is not started. With nested blocks, only the outermost one restarts play. After
        the restart the client's own step mode is in force again; in live mode physics starts paused.

        If the block raises, play is not restarted and continues without the edits. The edits made so far stay in the
        level, because the editor has no op to undo them. A note on the exception reports this.

        Args:
            timeout_s: Seconds to wait for the compile.

        Raises:
            URLabPIEError: On leaving, the edited level did not compile. The edits stay, and play is off.

        Example:
            async with client.scene.edit():
                await client.scene.spawn_actor(robot, "left", location=(0, 1, 0))
                await client.scene.spawn_actor(robot, "right", location=(0, -1, 0))
        """
        return SceneEdit(self._begin_edit, lambda well: self._end_edit(well=well, timeout_s=timeout_s))

    def _begin_edit(self) -> None:
        self._edits += 1

    async def _end_edit(self, *, well: bool, timeout_s: float) -> None:
        self._edits -= 1
        if not well or self._edits or (await self._sim.status()).state is PIEState.OFF:
            return
        await self._sim.stop()
        await self._sim.start(timeout_s=timeout_s)

    async def import_xml(
        self,
        xml_path: str,
        *,
        force_reimport: bool = False,
        on_progress: Callable[[JobStatus], object] | None = None,
        timeout: Timeout = DEFAULT,
    ) -> URLabBlueprint:
        """Import an MJCF file on the server's machine as a blueprint for `spawn_actor`.

        Args:
            xml_path: Absolute path of the MJCF file.
            force_reimport: Replace an existing blueprint of the same file stem.
            on_progress: Callback invoked repeatedly with the progress of the import, if the server reports it.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            ImportFailed: The file is missing or was rejected, or the old blueprint could not be removed.
        """
        request = ImportXml(path=str(xml_path), force_reimport=force_reimport)
        reply = await self._call(request, timeout, on_progress)
        return URLabBlueprint(
            class_path=reply.blueprint_class_path,
            short_name=reply.blueprint_short_name,
            imported_now=reply.imported_now,
        )

    async def spawn_actor(
        self,
        blueprint: URLabBlueprint | str,
        actor_id: str,
        *,
        location: Vector = (0.0, 0.0, 0.0),
        rotation_quat: Vector | None = None,
        rotation_euler: Vector | None = None,
        scale: Vector = (1.0, 1.0, 1.0),
        timeout: Timeout = DEFAULT,
    ) -> URLabSpawnHandle:
        """Place an instance of a blueprint in the edited level, or move the actor that has the id.

        Args:
            blueprint: Return value of `import_xml`, or a package or class path.
            actor_id: Stable id; empty always places a new actor.
            location: Position in the world frame, metres.
            rotation_quat: Unit quaternion (x, y, z, w), MuJoCo's world frame; overrides `rotation_euler`.
            rotation_euler: (roll, pitch, yaw) in degrees: Rz(yaw) Ry(-pitch) Rx(-roll) in MuJoCo's frame.
            scale: Scale factors.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            SpawnFailed: The class cannot be spawned, or the id belongs to an actor of another class.
        """
        place = as_vec3("location", location)
        request = SpawnActor(
            blueprint=_class_path(blueprint),
            actor_id=actor_id,
            location=place,
            rotation_quat=as_quat("rotation_quat", rotation_quat),
            rotation_euler=as_vec3("rotation_euler", rotation_euler),
            scale=as_vec3("scale", scale),
        )
        reply = await self._call(request, timeout)
        # The location that the plugin echoes is wrong by a factor of 100 and in the sign of y.
        return fill(URLabSpawnHandle, reply, location=place)

    async def spawn_light(
        self,
        kind: str = "directional",
        actor_id: str = "",
        *,
        location: Vector = (0.0, 0.0, 0.0),
        rotation_euler: Vector = (0.0, 0.0, 0.0),
        intensity: float = 5000.0,
        color: Vector = (1.0, 1.0, 1.0),
        timeout: Timeout = DEFAULT,
    ) -> URLabLightHandle:
        """Place a light; each call adds one. It shines along its local +x.

        Args:
            kind: `directional`, `point` or `spot`.
            actor_id: Stable id; not checked for reuse.
            location: Position in the world frame, metres.
            rotation_euler: (roll, pitch, yaw) in degrees, Unreal's frame.
            intensity: Intensity in Unreal's unit for that kind of light.
            color: Red, green, blue in [0, 1].
            timeout: Seconds to wait; None waits without limit.

        Raises:
            SpawnFailed: The kind is unknown.
        """
        euler = as_vec3("rotation_euler", rotation_euler)
        request = SpawnLight(
            kind=kind,
            actor_id=actor_id,
            location=as_vec3("location", location),
            rotation_euler=euler,
            intensity=finite("spawn_light: intensity", intensity),
            color=as_vec3("color", color),
        )
        reply = await self._call(request, timeout)
        return fill(URLabLightHandle, reply, rotation_euler=reply.rotation_euler or euler)

    async def destroy_actor(self, target: str, *, by_name: bool = False, timeout: Timeout = DEFAULT) -> None:
        """Remove an actor from the edited level.

        Args:
            target: Actor id, or the engine's actor name with `by_name`.
            by_name: Look `target` up by the engine's actor name instead of the actor id.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            DestroyFailed: No actor matches.
        """
        kind = RemoveActor if self._session.features.remove_op == "remove_actor" else DestroyActor
        await self._call(kind(target=target, target_by=target_by(by_name)), timeout)

    async def snapshot(self, *, timeout: Timeout = DEFAULT) -> SceneSnapshot:
        """Describe every visible actor, with articulation metadata; during play, of the play world.

        Raises:
            SnapshotFailed: There is no world to describe.
        """
        reply = await self._call(Snapshot(), timeout)
        return SceneSnapshot(
            actors=[_scene_actor(row) for row in reply.actors], in_pie=reply.in_pie, level_path=reply.level_path
        )

    async def duplicate_actor(
        self,
        target: str,
        new_actor_id: str,
        *,
        by_name: bool = False,
        location: Vector | None = None,
        timeout: Timeout = DEFAULT,
    ) -> URLabSpawnHandle:
        """Spawn another instance of an actor's class with the same rotation and scale.

        The plugin reports neither pose nor flags of the copy; the client reads them from the actor list.

        Args:
            target: Actor id, or the engine's actor name with `by_name`.
            new_actor_id: Id of the copy; an existing id moves that actor.
            by_name: Look `target` up by the engine's actor name.
            location: Position of the copy in the world frame, metres; default 1 m along x from the source.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            DuplicateFailed: No actor matches, or the new id belongs to an actor of another class.
        """
        before = await self._call(ListActors(), timeout)
        request = DuplicateActor(
            target=target,
            new_actor_id=new_actor_id,
            target_by=target_by(by_name),
            location=as_vec3("location", location),
        )
        reply = await self._call(request, timeout)
        after = await self._call(ListActors(), timeout)
        copy = next((row for row in after.actors if row.name == reply.actor_name), None)
        return fill(
            URLabSpawnHandle,
            reply,
            location=request.location or (copy.location if copy else (0.0, 0.0, 0.0)),
            rotation_quat=copy.rotation_quat if copy else IDENTITY,
            was_existing=any(row.name == reply.actor_name for row in before.actors),
            requires_pie_restart=after.in_pie,
        )

    async def spawn_grid(
        self,
        blueprint: URLabBlueprint | str,
        base_actor_id: str,
        count_x: int,
        count_y: int,
        *,
        spacing: Vector = (1.0, 1.0, 0.0),
        origin: Vector = (0.0, 0.0, 0.0),
        rotation_quat: Vector | None = None,
        rotation_euler: Vector | None = None,
        scale: Vector = (1.0, 1.0, 1.0),
        on_progress: Callable[[JobStatus], object] | None = None,
        timeout: Timeout = DEFAULT,
    ) -> dict[str, URLabSpawnHandle]:
        """Place a grid of actors in one request and return their handles by actor id.

        Cell (i, j) is at origin + (i spacing[0], j spacing[1], 0) and has the id `<base>_<i>_<j>`.

        Args:
            blueprint: Return value of `import_xml`, or a package or class path.
            base_actor_id: Prefix of the ids.
            count_x: Cells along x.
            count_y: Cells along y; at most 1024 cells in total.
            spacing: Distance between cells, metres; the third number is ignored.
            origin: Position of cell (0, 0) in the world frame, metres.
            rotation_quat: Unit quaternion (x, y, z, w), MuJoCo's world frame; overrides `rotation_euler`.
            rotation_euler: (roll, pitch, yaw) in degrees: Rz(yaw) Ry(-pitch) Rx(-roll) in MuJoCo's frame.
            scale: Scale factors.
            on_progress: Callback invoked repeatedly with the progress, if the server reports it.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            InvalidCount: A count is not above 0.
            TooManyCells: There are more than 1024 cells.
            SpawnFailed: A cell could not be placed; the plugin keeps the cells placed before it.
        """
        given = as_quat("rotation_quat", rotation_quat)
        euler = as_vec3("rotation_euler", rotation_euler)
        rotation = given or (IDENTITY if euler is None else euler_to_quat(euler))
        request = SpawnGrid(
            blueprint=_class_path(blueprint),
            base_actor_id=base_actor_id,
            count_x=count_x,
            count_y=count_y,
            spacing=as_vec3("spacing", spacing),
            origin=as_vec3("origin", origin),
            rotation_quat=given,
            rotation_euler=euler,
            scale=as_vec3("scale", scale),
        )
        reply = await self._call(request, timeout, on_progress)
        return {cell.actor_id: fill(URLabSpawnHandle, cell, reply, rotation_quat=rotation) for cell in reply.actors}

    async def upload_model(
        self,
        model: str | os.PathLike[str] | mujoco.MjSpec,
        *,
        on_progress: Callable[[UploadProgress], object] | None = None,
        timeout: Timeout = DEFAULT,
    ) -> URLabBlueprint:
        """Upload a model from this machine to the server and import it as a blueprint for `spawn_actor`.

        Files that the server already has, from any client, are not sent again. Each upload replaces the blueprint of
        the previous one; to have two uploaded robots in one level, combine them in one MJCF.

        Args:
            model: An MJCF file, which may include others, or a spec.
            on_progress: Callback invoked after each chunk that was sent.
            timeout: Seconds to wait for each request; None waits without limit. By default the import may take ten
                minutes.

        Raises:
            UnknownOp: The server does not accept uploads; nothing was sent.
            FileNotFoundError: The file does not exist.
            ValueError: MuJoCo rejects the model, or it is larger than servers accept; nothing was sent.
            ImportFailed: The server rejects the model.
            OutcomeUnknown: The connection broke during the import.
        """
        if not self._session.features.uploads:
            raise UnknownOp(
                "unknown_op",
                "this server does not accept uploaded models. Nothing was sent.",
                op="upload_model_manifest",
                hint="Copy the file to the server's machine and use import_xml().",
            )
        flat = await anyio.to_thread.run_sync(flatten, model, abandon_on_cancel=True)
        reply = await upload(flat, partial(self._call, timeout=timeout), on_progress)
        return URLabBlueprint(
            class_path=reply.blueprint_class_path, short_name=reply.blueprint_short_name, imported_now=reply.imported
        )

    async def apply_scene(
        self, level_name: str, assets: Iterable[URLabAsset], *, save: bool = True, timeout: Timeout = DEFAULT
    ) -> dict[str, URLabSpawnHandle]:
        """Bring a level into a described state: load or create it, import each MJCF once, place each asset, save.

        Safe to repeat: an actor whose id exists is moved, not spawned again. Scene changes by other tasks wait until
        this call has finished. At most one MJCF that exists only on this machine is uploaded, if the server accepts
        uploads.

        Args:
            level_name: Short name or `/Game/` path.
            assets: Actors to place.
            save: Save the level afterwards.
            timeout: Seconds to wait for each op; None waits without limit.

        Returns:
            Handles by actor id.

        Raises:
            ValueError: Two assets share an actor id; nothing was done. Or two MJCF files would have to be uploaded.
            URLabRPCError: An op failed; actors placed before it stay.
        """
        require("apply_scene: assets", assets, Iterable, "a list of URLabAsset")
        wanted = list(assets)
        for asset in wanted:
            require("apply_scene: assets", asset, URLabAsset, "a list of URLabAsset")
        ids = [asset.actor_id for asset in wanted]
        twice = sorted({i for i in ids if ids.count(i) > 1})
        if twice:
            raise ValueError(f"actor ids must differ; these are used twice: {', '.join(twice)}")
        async with self._session.composing(CreateLevel, timeout):
            try:
                await self.create_level(level_name, timeout=timeout)
            except CreateLevelFailed:
                await self.load_level(level_name, timeout=timeout)
            await self.ensure_manager(timeout=timeout)
            blueprints = await self._imported(list(dict.fromkeys(asset.xml for asset in wanted)), timeout)
            handles = {
                asset.actor_id: await self.spawn_actor(
                    blueprints[asset.xml],
                    asset.actor_id,
                    location=asset.location,
                    rotation_quat=asset.rotation_quat,
                    rotation_euler=asset.rotation_euler,
                    scale=asset.scale,
                    timeout=timeout,
                )
                for asset in wanted
            }
            if save:
                await self.save_level(timeout=timeout)
            return handles

    async def _imported(self, files: list[str], timeout: Timeout) -> dict[str, URLabBlueprint]:
        """Import models from the server's disk, otherwise from this machine if the server accepts uploads."""
        blueprints: dict[str, URLabBlueprint] = {}
        uploaded = ""
        for xml in files:
            try:
                blueprints[xml] = await self.import_xml(xml, timeout=timeout)
            except ImportFailed as refusal:
                if not self._session.features.uploads or not await anyio.to_thread.run_sync(Path(xml).is_file):
                    raise
                if uploaded:
                    raise ValueError(
                        f"apply_scene: the server has neither {uploaded} nor {xml} on its disk, and an uploaded model "
                        "replaces the previous one; combine them in one MJCF"
                    ) from refusal
                blueprints[xml] = await self.upload_model(xml, timeout=timeout)
                uploaded = xml
        return blueprints


def _class_path(blueprint: URLabBlueprint | str) -> str:
    if isinstance(blueprint, str):
        return blueprint
    require("blueprint", blueprint, URLabBlueprint, "the return value of import_xml(), or a class path")
    return blueprint.class_path


def _scene_actor(row: SnapshotRow) -> SceneActor:
    parts = () if row.urlab is None else ("joints", "actuators", "sensors", "cameras")
    names = {part: tuple(getattr(row.urlab, part)) for part in parts}
    return fill(SceneActor, row, tags=tuple(row.tags), is_articulation=row.urlab is not None, **names)
