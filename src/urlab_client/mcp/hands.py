"""Moving a hand: the whole way is planned and checked before anything moves, then driven and corrected.

Poses are in the world frame: metres, z up, quaternions (w, x, y, z).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Final

import anyio.to_thread
import numpy as np
from msgspec import Meta, Struct

from urlab_client.mcp.call import Call, Stopped
from urlab_client.mcp.results import HandMoved, HandPose, label
from urlab_client.protocol.base import Floats
from urlab_client.values.rotation import Quat, normalized

if TYPE_CHECKING:
    from urlab_client.aio import URLabArticulation, URLabClient
    from urlab_client.integrations.ik import InverseKinematics

_STEP_M: Final = 0.02
_STEP_RAD: Final = 0.1
_JOINT_SPEED: Final = 1.0  # rad/s or m/s
_GRIPPER_S: Final = 0.6
_REST_S: Final = 0.05
_AT_REST_M: Final = 2e-4  # within _REST_S
_RESTS: Final = 40
_CORRECTIONS: Final = 4
_GOOD_M: Final = 2e-3
_TOLERANCE_M: Final = 0.01
_TOLERANCE_RAD: Final = 0.1
_TOUCHED: Final = 200


Metres = Annotated[float, Meta(ge=-1e4, le=1e4)]
Position = Annotated[list[Metres], Meta(description="(x, y, z), metres, world frame.", min_length=3, max_length=3)]
Component = Annotated[float, Meta(ge=-1e3, le=1e3)]
Quaternion = Annotated[
    list[Component],
    Meta(
        description="(w, x, y, z), world frame; (cos A/2, 0, 0, sin A/2) turns by A about the vertical.",
        min_length=4,
        max_length=4,
    ),
]


class Waypoint(Struct, frozen=True, forbid_unknown_fields=True):
    """One pose of a hand; what is left out stays as it is.

    Attributes:
        gripper: Set-point that the gripper gets there.
    """

    position: Position | None = None
    quaternion: Quaternion | None = None
    gripper: float | None = None


class _Leg(Struct, eq=False):
    """The way to one pose: joint positions one after another, the seconds that each takes, and what to do there."""

    path: list[dict[str, float]]
    seconds: list[float]
    position: Floats
    quaternion: Floats | None
    gripper: float | None


def solver(client: URLabClient, robot: URLabArticulation, hand: str | None) -> InverseKinematics:
    """Return the inverse kinematics of a robot's hand: a site or body of this name, or the only one of `look`."""
    from urlab_client.integrations.ik import InverseKinematics, hand_frames, own_sites

    if hand is not None:
        kind = {"body": hand} if hand not in own_sites(client, robot) and hand in robot.bodies else {"site": hand}
        return InverseKinematics(client, robot.prefix, **kind)
    found = hand_frames(client, robot)
    if len(found) != 1:
        names = ", ".join(name for one in found for name in one.values())
        raise ValueError(
            f"{robot.name} has several hands: pass `hand`, one of {names}."
            if found
            else f"{robot.name} has no joint with a position servo, so there is no hand to move."
        )
    return InverseKinematics(client, robot.prefix, **found[0])


def hands(client: URLabClient) -> list[HandPose]:
    """Return the hands of all robots and their poses."""
    from urlab_client.integrations.ik import InverseKinematics, hand_frames

    found = [(robot, frame) for robot in client.articulations.values() for frame in hand_frames(client, robot)]
    return [pose_of(robot, InverseKinematics(client, robot.prefix, **frame)) for robot, frame in found]


def pose_of(robot: URLabArticulation, ik: InverseKinematics) -> HandPose:
    """Return the present pose of a hand."""
    position, quaternion = ik.pose()
    grip = ik.gripper
    return HandPose(
        robot=robot.actor_id or robot.name,
        hand=ik.frame,
        position=position.tolist(),
        quaternion=quaternion.tolist(),
        gripper=None if grip is None else grip.value,
        gripper_limits=None if grip is None else grip.ctrlrange,
    )


async def follow(call: Call, robot: str, poses: list[Waypoint], hand: str | None, speed: float) -> HandMoved:
    """Move a hand through poses.

    Raises:
        ValueError: A pose is out of reach, or the way to it collides. Nothing has moved.
        Stopped: The hand was obstructed; the message says where it is and what it touches.
    """
    client, found = call.client, call.robot(robot)
    ik = await anyio.to_thread.run_sync(solver, client, found, hand)
    legs = await anyio.to_thread.run_sync(lambda: list(_planned(client, found, ik, poses, speed)))
    rest = _REST_S * 4 * len(legs) + sum(_GRIPPER_S for leg in legs if leg.gripper is not None)
    call.within(sum(sum(leg.seconds) for leg in legs) + rest)
    passed = 0.0
    for number, leg in enumerate(legs, 1):
        passed += await _driven(client, found, ik, leg)
        at, turned = ik.pose()
        short, turn = float(np.linalg.norm(leg.position - at)), _angle(turned, leg.quaternion)
        if short > _TOLERANCE_M or turn > _TOLERANCE_RAD:
            raise Stopped(
                f"The hand was obstructed on its way to pose {number} of {len(legs)}: it is at {_listed(at)} m, "
                f"{short:.3f} m and {turn:.2f} rad from that pose{await _touched(call, found)}. It still presses; move "
                "it back, or go another way."
            )
        if leg.gripper is not None and ik.gripper is not None:
            ik.gripper.set_control(leg.gripper)
            passed += await client.run_for(_GRIPPER_S)
    last = legs[-1]
    error = float(np.linalg.norm(last.position - ik.pose()[0]))
    return HandMoved(pose=pose_of(found, ik), error=error, reached=len(legs), passed=passed)


def _planned(
    client: URLabClient, robot: URLabArticulation, ik: InverseKinematics, poses: list[Waypoint], speed: float
) -> Iterator[_Leg]:
    at, turned = ik.pose()
    joints = {name: float(robot.joints[name].position) for name in ik.joints}
    for number, pose in enumerate(poses, 1):
        which = f"Pose {number} of {len(poses)}: " if len(poses) > 1 else ""
        if pose.gripper is not None:
            _check_gripper(ik, robot, pose.gripper)
        aim = at if pose.position is None else np.array(pose.position)
        asked = None if pose.quaternion is None else np.array(unit(pose.quaternion))
        end = ik.solve(aim, turned if asked is None else asked, start=joints, nearest=True)
        turn = turned if asked is None else asked
        if not end.reached and asked is None:
            end, turn = ik.solve(aim, start=joints, nearest=True), None
        if not end.reached:
            nearest = ik.pose(end.joints)[0]
            away = f"{end.position_error:.3f} m and {end.rotation_error:.2f} rad away"
            raise ValueError(
                f"{which}{_listed(aim)} m is out of reach: the nearest that {ik.frame!r} gets to is "
                f"{_listed(nearest)} m, {away}. The hand has not moved."
            )
        straight = _straight(ik, joints, (at, turned), (aim, turn))
        ways = [way for way in (straight, _in_joints(joints, end.joints)) if way is not None]
        hits = [ik.collisions(way) for way in ways]
        if None not in hits:
            index, *names = hits[0] or (0, "", "")
            free = ik.pose(ways[0][index - 1] if index else joints)[0]
            first, second = (label(client, name) for name in names)
            raise ValueError(
                f"{which}on the way to {_listed(aim)} m {first} would run into {second}. The way is free up to "
                f"{_listed(free)} m, {float(np.linalg.norm(aim - free)):.3f} m before it. The hand has not moved."
            )
        path = ways[hits.index(None)]
        seconds: list[float] = []
        for one, other in pairwise([joints, *path]):
            distance = float(np.linalg.norm(ik.pose(other)[0] - ik.pose(one)[0]))
            largest = max(abs(other[name] - one[name]) for name in other)
            seconds.append(max(distance / speed, largest / _JOINT_SPEED))
        yield _Leg(path, seconds, aim, turn if pose.quaternion is not None else None, pose.gripper)
        joints = path[-1]
        at, turned = ik.pose(joints)


def _straight(
    ik: InverseKinematics, joints: dict[str, float], start: tuple[Floats, Floats], end: tuple[Floats, Floats | None]
) -> list[dict[str, float]] | None:
    """Return the joints along a straight line, or None if the robot cannot follow it."""
    (at, turned), (aim, turn) = start, end
    angle = _angle(turned, turn)
    count = max(1, math.ceil(max(float(np.linalg.norm(aim - at)) / _STEP_M, angle / _STEP_RAD)))
    path: list[dict[str, float]] = []
    for i in range(1, count + 1):
        share = i / count
        partly = None if turn is None else _between(turned, turn, share)
        found = ik.solve(at + share * (aim - at), partly, start=joints, starts=1, nearest=True)
        largest = max(abs(found.joints[name] - joints[name]) for name in joints)
        if not found.reached or largest > 10 * _STEP_RAD:  # it would swing round to another posture
            return None
        joints = found.joints
        path.append(joints)
    return path


def _in_joints(start: dict[str, float], end: dict[str, float]) -> list[dict[str, float]]:
    count = max(1, math.ceil(max(abs(end[name] - start[name]) for name in end) / _STEP_RAD))
    return [{name: start[name] + i / count * (end[name] - start[name]) for name in end} for i in range(1, count + 1)]


async def _driven(client: URLabClient, robot: URLabArticulation, ik: InverseKinematics, leg: _Leg) -> float:
    """Drive one leg, wait until the hand rests, and correct what gravity and friction leave; return the time."""
    passed = 0.0
    for joints, seconds in zip(leg.path, leg.seconds, strict=True):
        robot.set_ctrl(ik.set_points(joints))
        passed += await client.run_for(max(seconds, 1e-3))
    goal = leg.path[-1]
    sent, best = dict(goal), math.inf
    for _ in range(_CORRECTIONS):
        at = ik.pose()[0]
        for _ in range(_RESTS):
            passed += await client.run_for(_REST_S)
            before, at = at, ik.pose()[0]
            if float(np.linalg.norm(at - before)) < _AT_REST_M:
                break
        error = float(np.linalg.norm(leg.position - at))
        if error < _GOOD_M or error > 0.9 * best:
            break
        best = error
        sent = {name: sent[name] + goal[name] - float(robot.joints[name].position) for name in goal}
        robot.set_ctrl(ik.set_points(sent))
    return passed


async def _touched(call: Call, robot: URLabArticulation) -> str:
    """Return what the robot touches."""
    found = await call.client.runtime.get_contacts(max_contacts=_TOUCHED)
    own, names = robot.actor_id or robot.name, set[str]()
    for one in found.contacts:
        pair = [label(call.client, one.body1, one.geom1), label(call.client, one.body2, one.geom2)]
        mine = [name.split("/")[0] == own for name in pair]
        names |= {pair[1 - i] for i in (0, 1) if mine[i] and not mine[1 - i]}
    return f", and touches {', '.join(sorted(names))}" if names else ""


def _check_gripper(ik: InverseKinematics, robot: URLabArticulation, value: float) -> None:
    grip = ik.gripper
    if grip is None:
        raise ValueError(f"{robot.name} has no gripper that can be told from its other actuators: use set_actuators.")
    low, high = grip.ctrlrange or (value, value)
    if not low <= value <= high:
        raise ValueError(f"gripper takes {low:g} to {high:g}, got {value:g}. The hand has not moved.")


def _angle(one: Floats, other: Floats | None) -> float:
    return 0.0 if other is None else 2.0 * math.acos(min(1.0, abs(float(one @ other))))


def _between(one: Floats, other: Floats, share: float) -> Floats:
    """Return the orientation at a share of the shortest turn from one to another."""
    from mink import SO3

    return SO3(one).interpolate(SO3(other), share).wxyz


def unit(quaternion: list[float]) -> Quat:
    """Return an orientation that an agent gave as a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return normalized((w, x, y, z))


def _listed(values: Floats) -> str:
    return f"({', '.join(f'{value:.3f}' for value in values)})"
