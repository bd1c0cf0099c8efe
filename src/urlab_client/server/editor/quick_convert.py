"""Quick Convert: static meshes of the level that become bodies of the simulation."""

from __future__ import annotations

from dataclasses import replace

from urlab_client.server.assets.actors import UNIT_SCALE, Actor, ConversionSettings
from urlab_client.server.assets.decomposition import advice, is_available
from urlab_client.server.editor import checks
from urlab_client.server.editor.level_actors import LevelActors
from urlab_client.server.refusal import Refusal
from urlab_client.values.rotation import Vec3


class QuickConvert:
    """The Quick Convert settings of the actors of the open level."""

    def __init__(self, actors: LevelActors) -> None:
        """Change the settings of these actors."""
        self._actors = actors

    def add(
        self,
        target: str,
        *,
        static: bool = False,
        complex_mesh: bool = False,
        coacd_threshold: float = 0.05,
        driven_by_unreal: bool = False,
        friction: Vec3 = UNIT_SCALE,
    ) -> Actor:
        """Make a static mesh actor a MuJoCo body from the next play on. Repeating it replaces all settings.

        Args:
            complex_mesh: Several convex parts of a mesh file instead of one hull; needs CoACD.
            coacd_threshold: Concavity that a part may keep.

        Raises:
            Refusal: `missing_field`; `add_quick_convert_failed` for an unknown actor, one without a mesh, a plane that
                is not static, a number that is not finite, or `complex_mesh` without CoACD.
        """
        code = "add_quick_convert_failed"
        actor = self._actors.find(target, code)
        if actor.mesh is None:
            raise Refusal(code, f"'{actor.name}' is a {actor.class_name} without a mesh of its own")
        if complex_mesh and not is_available():
            raise Refusal(code, advice())
        if actor.mesh.shape == "plane" and not static:
            raise Refusal(code, f"'{actor.name}' is a plane, which cannot move: pass static")
        checks.refuse_infinite((coacd_threshold, *friction), "coacd_threshold and friction", code)
        settings = ConversionSettings(
            static=static,
            complex_mesh=complex_mesh,
            coacd_threshold=checks.float32(coacd_threshold),
            driven_by_unreal=driven_by_unreal,
            friction=friction,
        )
        return self._actors.put(replace(actor, quick_convert=settings))

    def remove(self, target: str) -> Actor:
        """Make a static mesh actor decoration again."""
        code = "remove_quick_convert_failed"
        actor = self._actors.find(target, code)
        if actor.quick_convert is None:
            raise Refusal(code, f"'{actor.name}' has no Quick Convert settings")
        return self._actors.put(replace(actor, quick_convert=None))
