"""Inverse kinematics: joint positions, within their limits, that bring a site or body of a robot to a pose.

The solver is mink. Needs the extra `teleop`.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from typing import Any, Final

import mujoco
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from urlab_client._installation import need
from urlab_client._mujoco import model_names
from urlab_client.aio.arguments import finite, finite_array
from urlab_client.aio.articulation import URLabArticulation as AsyncArticulation
from urlab_client.aio.articulation import compiled_prefixes
from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.aio.model.elements import Actuator, Joint
from urlab_client.aio.model.mirror import require_local
from urlab_client.errors import URLabError
from urlab_client.protocol.base import Floats
from urlab_client.sync.articulation import URLabArticulation
from urlab_client.sync.client import URLabClient
from urlab_client.values.names import NameMap, own_aliases, split_prefix
from urlab_client.values.plain import Serializable

need("mink", extra="teleop")

import mink  # noqa: E402

__all__ = ["IkSolution", "InverseKinematics", "UnreachableTarget"]

Vector = Sequence[float] | Floats

_ITERATIONS: Final = 60
_STALLED: Final = 1e-6  # rad or m; if an iteration moves the joints by less, the search has converged
_LARGEST_STEP: Final = 0.5  # rad or m per iteration: Jacobians are only valid locally
_DAMPING: Final = 1e-6
_LM_DAMPING: Final = 1e-2
_STARTS: Final = 8
_PENETRATION: Final = 1e-3  # m: bodies that merely touch do not collide


class IkSolution(Serializable, Struct, frozen=True, kw_only=True):
    """Joint positions, and the remaining distance of the frame from its target.

    Attributes:
        joints: Position of each solved joint, rad or m, by name, in the format of `move_to`.
        set_points: Set-points that hold these positions, by actuator name, in the format of `set_ctrl`.
        position_error: Distance of the frame's origin from the target, metres.
        rotation_error: Angle between the frame's orientation and the target's, rad; 0 without a target orientation.
        reached: Whether both errors are within the tolerances.
        iterations: Number of quadratic programs solved.
    """

    joints: dict[str, float]
    set_points: dict[str, float]
    position_error: float
    rotation_error: float
    reached: bool
    iterations: int


class UnreachableTarget(URLabError, ValueError):
    """The search found no joint positions within the limits that reach the target.

    Attributes:
        nearest: The nearest solution found.
    """

    def __init__(self, message: str, nearest: IkSolution, *, hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.nearest = nearest


class InverseKinematics:
    """Solves for the joints that move one frame of a robot.

    These are the hinge and slide joints between the frame and the robot's root that a position servo or a PD controller
    holds. Everything else (other joints, a free base, other robots) stays in the state of the last reply. Make a new
    instance after another `discover()`. Use an instance from one thread at a time.

    Poses are in the MuJoCo world frame: metres, z up, quaternions (w, x, y, z). Collisions are not considered.

    Attributes:
        frame: Name of the site or body.
        joints: Names of the joints, starting at the root.
    """

    def __init__(
        self,
        client: URLabClient | AsyncClient,
        articulation: str | None = None,
        *,
        site: str | None = None,
        body: str | None = None,
        joints: Iterable[str] | None = None,
    ) -> None:
        """Set up the solver.

        Args:
            client: A client of either flavour after `discover()`, with a local model.
            articulation: Key of the robot; optional if the scene has only one.
            site: Short name of a site, the frame. Give either `site` or `body`.
            body: Short name of a body, the frame.
            joints: Joints to solve for; by default, all that move the frame.

        Raises:
            KeyError: The articulation, site, body or joint does not exist.
            ValueError: Not exactly one frame is given, no position-controlled joint moves it, or a joint of `joints`
                does not.
            URLabError: The client has no local model, or the scene does not have exactly one robot and `articulation`
                is None.
        """
        model = require_local(client.model, "Inverse kinematics")
        self._client = client
        self._source = model
        self._robot = only_robot(client, articulation)
        if (site is None) is (body is None):
            raise ValueError("give exactly one frame: either site=NAME or body=NAME")
        kind, name = ("site", site) if site is not None else ("body", body or "")
        self.frame: str = name
        self._kind = kind
        self._id = self._robot.bodies[name].id if kind == "body" else own_sites(client, self._robot)[name]
        root = int(model.site_bodyid[self._id]) if kind == "site" else self._id
        held = _held(self._robot, _chain(model, root), None if joints is None else [*joints], f"{kind} {name!r}")
        self.joints: tuple[str, ...] = tuple(held)
        self._held = [(self._robot.joints[joint], actuator) for joint, actuator in held.items()]
        self._places = self._robot.joints.over({joint: i for i, joint in enumerate(held)})
        self._places.owner = f"the chain to {name!r}"
        ids = [joint.id for joint, _ in self._held]
        self._qpos: NDArray[np.intp] = np.array(model.jnt_qposadr[ids], dtype=np.intp)
        self._low, self._high = np.array([_range(joint, actuator) for joint, actuator in self._held]).T
        self._private = _restricted(model, ids, self._low, self._high)
        self._configuration: Any = mink.Configuration(self._private)
        self._task: Any = mink.FrameTask(model_names(model, kind)[self._id], kind, 1.0, 1.0, lm_damping=_LM_DAMPING)
        dofs = np.array(model.jnt_dofadr[ids], dtype=np.intp)
        frozen = sorted(set(range(model.nv)) - set(dofs.tolist()))
        self._frozen: list[Any] = [mink.DofFreezingTask(self._private, frozen)] if frozen else []
        self._limits: list[Any] = [mink.ConfigurationLimit(self._private, gain=1.0)]
        self._dofs = dofs

    @property
    def gripper(self) -> Actuator | None:
        """The only actuator with a range that does not move the frame, if there is exactly one."""
        moving = {actuator.name for _, actuator in self._held}
        others = [one for name, one in self._robot.actuators.items() if name not in moving and one.ctrlrange]
        return others[0] if len(others) == 1 else None

    def pose(self, joints: dict[str, float] | None = None) -> tuple[Floats, Floats]:
        """Return the pose of the frame.

        Args:
            joints: Positions of some of `self.joints`, rad or m. The others are those of the last reply.

        Returns:
            Position, metres, shape (3,), and orientation (w, x, y, z), shape (4,), in the world frame.

        Raises:
            KeyError: A joint is not one of `self.joints`.
        """
        qpos = self._present()
        for name, position in (joints or {}).items():
            qpos[self._qpos[self._places[name]]] = finite(f"joint {name!r}", position)
        self._configuration.update(qpos)
        return self._frame_pose()

    def set_points(self, joints: dict[str, float]) -> dict[str, float]:
        """Return the set-points that hold joint positions, within the actuators' ranges, in the format of `set_ctrl`.

        Args:
            joints: Positions of `self.joints`, rad or m.
        """
        held = zip(self._held, np.clip(self._positions(joints), self._low, self._high), strict=True)
        return {actuator.name: actuator.set_point_for(float(value)) for (_, actuator), value in held}

    def solve(
        self,
        position: Vector,
        quaternion: Vector | None = None,
        *,
        start: dict[str, float] | None = None,
        starts: int = _STARTS,
        tolerance: float = 1e-3,
        rotation_tolerance: float = 1e-2,
        nearest: bool = False,
    ) -> IkSolution:
        """Return joint positions that bring the frame to a pose. Nothing is sent, and nothing moves.

        The search starts at the current joint positions, so that small changes of the target lead to small movements.
        If it gets stuck, it restarts in the middle of the joint ranges and then at random positions, always the same.

        Args:
            position: Target of the frame's origin, metres, world frame, shape (3,).
            quaternion: Target orientation (w, x, y, z), world frame, of any length except 0. None leaves it free.
            start: Positions of some of `self.joints` to start from, rad or m.
            starts: Largest number of starts.
            tolerance: Distance within which the target counts as reached, metres.
            rotation_tolerance: Angle within which the target counts as reached, rad.
            nearest: Whether to return the nearest positions, with `reached` False, if the target is not reached.

        Raises:
            UnreachableTarget: The target was not reached. `.nearest` is the nearest solution.
            ValueError: A number is NaN, infinite or out of range, or a vector has the wrong length.
            KeyError: A joint of `start` is not one of `self.joints`.
            URLabError: The client's model has been replaced since.
        """
        aim = vector("position", position, 3)
        turn = None if quaternion is None else _unit(quaternion)
        if starts < 1:
            raise ValueError(f"starts must be at least 1, not {starts}")
        limits = positive("tolerance", tolerance), positive("rotation_tolerance", rotation_tolerance)
        found: list[IkSolution] = []
        for qpos in self._initial_positions(start, starts):
            found.append(self._descend(qpos, aim, turn, limits))
            if found[-1].reached:
                break
        best = min(found, key=lambda one: (not one.reached, _cost(one, limits)))
        best = best.replace(iterations=sum(one.iterations for one in found))
        if best.reached or nearest:
            return best
        angle = "" if turn is None else f" and {best.rotation_error:.3f} rad from the orientation"
        raise UnreachableTarget(
            f"{self._kind} {self.frame!r} of {self._robot.name!r} does not reach {_listed(aim)} m: the nearest found "
            f"is {best.position_error:.3f} m away{angle}, after {starts} starts.",
            best,
            hint="Choose a target within reach, or pass nearest=True for the nearest solution.",
        )

    def collisions(self, path: Iterable[dict[str, float]]) -> tuple[int, str, str] | None:
        """Return the first collision on a path. Nothing is sent, and nothing moves.

        What is checked is the robot against itself and against what cannot move. Bodies that can move do not count,
        because a hand may push or hold them, nor does what touches now.

        Args:
            path: Positions of `self.joints`, rad or m, one after another.

        Returns:
            Index in the path and the names of the two geoms or, if they have none, bodies; None without a collision.
        """
        model, data, qpos = self._private, mujoco.MjData(self._private), self._present()
        root = model.body_rootid[model.jnt_bodyid[self._held[0][0].id]]
        known = self._touching(data, qpos, root)
        for i, joints in enumerate(path):
            qpos[self._qpos] = self._positions(joints)
            for pair in self._touching(data, qpos, root) - known:
                first, second = (model.geom(g).name or model.body(model.geom_bodyid[g]).name for g in pair)
                return i, first, second
        return None

    def _touching(self, data: mujoco.MjData, qpos: Floats, root: int) -> set[tuple[int, int]]:
        """Return the pairs of geoms of the robot, or of the robot and what cannot move, that penetrate each other."""
        model = self._private
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        bodies = model.geom_bodyid[data.contact.geom]
        own = model.body_rootid[bodies] == root
        counts = own.any(axis=1) & (own | (model.body_weldid[bodies] == 0)).all(axis=1)
        return {(int(a), int(b)) for a, b in data.contact.geom[counts & (data.contact.dist < -_PENETRATION)]}

    def _present(self) -> Floats:
        if self._client.model is not self._source:
            raise URLabError(
                "The client's model has been replaced since.", hint="Make a new InverseKinematics after discover()."
            )
        data = require_local(self._client.data, "Inverse kinematics")
        with self._client._data_lock:  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]
            return np.array(data.qpos)

    def _positions(self, joints: dict[str, float]) -> list[float]:
        """Return the positions of all joints, in their order."""
        given = {self._robot.joints.key(name): position for name, position in joints.items()}
        return [given[name] for name in self.joints]

    def _initial_positions(self, start: dict[str, float] | None, starts: int) -> Iterable[Floats]:
        qpos = self._present()
        rng = np.random.default_rng(0)
        first: NDArray[np.float64] = qpos[self._qpos]
        for name, position in (start or {}).items():
            first[self._places[name]] = finite(f"start: joint {name!r}", position)
        low, high = np.maximum(self._low, -np.pi), np.minimum(self._high, np.pi)
        for i in range(starts):
            if i:
                first[:] = (low + high) / 2.0 if i == 1 else rng.uniform(low, high)
            qpos[self._qpos] = np.clip(first, self._low, self._high)
            yield qpos

    def _descend(self, qpos: Floats, aim: Floats, turn: Floats | None, limits: tuple[float, float]) -> IkSolution:
        configuration, task = self._configuration, self._task
        solve: Any = getattr(mink, "solve_ik")  # noqa: B009 - its options have no types
        configuration.update(qpos)
        task.set_orientation_cost(0.0 if turn is None else 1.0)
        iterations = 0
        while True:
            at, turned = self._frame_pose()
            # With a free orientation the target rotates with the frame: otherwise the error, a twist, mixes both.
            goal = turned if turn is None else turn
            errors = float(np.linalg.norm(aim - at)), 0.0 if turn is None else _angle(turned, turn)
            reached = errors[0] <= limits[0] and errors[1] <= limits[1]
            exact = errors[0] <= limits[0] / 10 and errors[1] <= limits[1] / 10
            if exact or iterations == _ITERATIONS:
                break
            task.set_target(mink.SE3.from_rotation_and_translation(mink.SO3(goal), aim))
            iterations += 1
            try:
                move: Floats = solve(
                    configuration,
                    [task],
                    1.0,
                    "daqp",
                    damping=_DAMPING,
                    limits=self._limits,
                    constraints=self._frozen or None,
                )
            except mink.NoSolutionFound:
                break
            largest = float(np.abs(move[self._dofs]).max())
            if largest < _STALLED:
                break
            configuration.integrate_inplace(move * min(1.0, _LARGEST_STEP / largest), 1.0)
        values = np.clip(configuration.data.qpos[self._qpos], self._low, self._high).tolist()
        joints = dict(zip(self.joints, values, strict=True))
        return IkSolution(
            joints=joints,
            set_points=self.set_points(joints),
            position_error=errors[0],
            rotation_error=errors[1],
            reached=reached,
            iterations=iterations,
        )

    def _frame_pose(self) -> tuple[Floats, Floats]:
        data = self._configuration.data
        rotation: Floats = (data.site_xmat if self._kind == "site" else data.xmat)[self._id]
        position: Floats = (data.site_xpos if self._kind == "site" else data.xpos)[self._id]
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, rotation)
        return position.copy(), quaternion

    def __repr__(self) -> str:
        return f"<InverseKinematics {self._kind} {self.frame!r} of {self._robot.name!r}>"


def only_robot(client: URLabClient | AsyncClient, key: str | None) -> URLabArticulation | AsyncArticulation:
    """Return an articulation by its key, or the only one."""
    robots = client.articulations
    if key is not None:
        return robots[key]
    if len(robots) != 1:
        raise URLabError(
            f"Name the articulation: the scene has {', '.join(robots) or 'none'}.",
            hint="Pass its key as the second argument.",
        )
    return next(iter(robots.values()))


def hand_frames(
    client: URLabClient | AsyncClient, robot: URLabArticulation | AsyncArticulation
) -> list[dict[str, str]]:
    """Return the frames that most position-controlled hinges of a robot move, in the form that the solver takes.

    They are sites or, if the robot has none there, the first bodies with all these hinges.
    """
    model = client.model
    if model is None:
        return []
    names = _servos(robot)
    hinges = {joint.id for joint in robot.joints.values() if joint.kind == "hinge" and joint.name in names}
    scores = {name: len(hinges.intersection(_chain(model, body.id))) for name, body in robot.bodies.items()}
    most = max(scores.values(), default=0)
    if not most:
        return []
    moved = {robot.bodies[name].id: name for name, score in scores.items() if score == most}
    sites = [{"site": name} for name, i in own_sites(client, robot).items() if int(model.site_bodyid[i]) in moved]
    return sites or [{"body": name} for i, name in moved.items() if int(model.body_parentid[i]) not in moved]


def own_sites(client: URLabClient | AsyncClient, robot: URLabArticulation | AsyncArticulation) -> NameMap[int]:
    """Return the ids of a robot's sites by their short names; empty without a local model."""
    prefixes = compiled_prefixes(client.articulations)
    names = [] if client.model is None else model_names(client.model, "site")
    owned = enumerate(split_prefix(names, [*prefixes.values()]))
    ids = {name: i for i, (owner, name) in owned if owner == robot.compiled_prefix}
    return NameMap(ids, own_aliases([*ids], robot.compiled_prefix, prefixes), "site", robot.name)


def _chain(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the joints that move a body, starting at the root."""
    found: list[int] = []
    while body:
        first = int(model.body_jntadr[body])
        found[:0] = range(first, first + int(model.body_jntnum[body]))
        body = int(model.body_parentid[body])
    return found


def _held(
    robot: URLabArticulation | AsyncArticulation, chain: list[int], wanted: list[str] | None, frame: str
) -> dict[str, Actuator]:
    """Return the position-controlled joints of a chain, each with its actuator."""
    by_id, servos = {joint.id: joint for joint in robot.joints.values()}, _servos(robot)
    names = (by_id[i].name for i in chain if i in by_id and by_id[i].unit)
    found = {name: servos[name] for name in names if name in servos}
    if wanted is not None:
        names = [robot.joints[name].name for name in wanted]
        if others := [name for name in names if name not in found]:
            raise ValueError(
                f"joint {others[0]!r} has no position servo that moves {frame}; joints with one: {', '.join(found)}"
            )
        found = {name: actuator for name, actuator in found.items() if name in names}
    if not found:
        raise ValueError(
            f"no position-controlled joint moves {frame} of {robot.name!r}: its joints need position servos or an "
            "active PD controller"
        )
    return found


def _servos(robot: URLabArticulation | AsyncArticulation) -> dict[str, Actuator]:
    """Return the first actuator that takes positions, by the name of its joint."""
    servos = [one for one in robot.actuators.values() if one.joint and one.describe().takes == "position"]
    return {str(one.joint): one for one in reversed(servos)}


def _range(joint: Joint, actuator: Actuator) -> tuple[float, float]:
    """Return the range of a joint: its own limits, intersected with the range that its actuator can hold."""
    low, high = joint.limits or (-np.inf, np.inf)
    limits = actuator.describe().limits
    per_unit = actuator.set_point_for(1.0)
    if limits is not None and per_unit:
        ends = sorted(limit / per_unit for limit in limits)
        low, high = max(low, ends[0]), min(high, ends[1])
    return low, max(low, high)


def _restricted(model: mujoco.MjModel, joints: list[int], low: Floats, high: Floats) -> mujoco.MjModel:
    """Return a copy in which only these joints have ranges: other joints may be outside their own ranges."""
    private = copy.copy(model)
    private.jnt_limited[:] = 0
    private.jnt_limited[joints] = np.isfinite(low) & np.isfinite(high)
    private.jnt_range[joints] = np.column_stack([low, high])
    return private


def vector(what: str, values: Vector, length: int) -> Floats:
    """Return numbers as an array of this length."""
    given = finite_array(what, values)
    if given.shape != (length,):
        raise ValueError(f"{what} takes {length} numbers, got an array of shape {given.shape}")
    return given


def _unit(quaternion: Vector) -> Floats:
    given = vector("quaternion", quaternion, 4)
    length = float(np.linalg.norm(given))
    if length < 1e-9:
        raise ValueError("quaternion is all zeros, which is not a valid orientation")
    return given / length


def positive(what: str, value: float) -> float:
    """Return a number as a float above 0."""
    number = finite(what, value)
    if number <= 0:
        raise ValueError(f"{what} must be above 0, not {number:g}")
    return number


def _angle(one: Floats, other: Floats) -> float:
    return 2.0 * float(np.arccos(min(1.0, abs(float(one @ other)))))


def _cost(solution: IkSolution, limits: tuple[float, float]) -> float:
    return solution.position_error / limits[0] + solution.rotation_error / limits[1]


def _listed(values: Floats) -> str:
    return f"({', '.join(f'{value:.3g}' for value in values)})"
