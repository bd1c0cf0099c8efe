"""Inverse kinematics: where joints must be for a site or body of a robot to be somewhere, within their limits.

It is solved by mink, which needs the extra `teleop`.
"""

from urlab_client._extras import need

need("mink", extra="teleop")

from urlab_client.integrations.ik.solver import IkSolution, InverseKinematics, UnreachableTarget  # noqa: E402

__all__ = ["IkSolution", "InverseKinematics", "UnreachableTarget"]
