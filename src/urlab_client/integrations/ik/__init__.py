"""Inverse kinematics: joint positions, within their limits, that bring a site or body of a robot to a pose.

The solver is mink. Needs the extra `teleop`.
"""

from urlab_client._installation import need

need("mink", extra="teleop")

from urlab_client.integrations.ik.solver import IkSolution, InverseKinematics, UnreachableTarget  # noqa: E402

__all__ = ["IkSolution", "InverseKinematics", "UnreachableTarget"]
