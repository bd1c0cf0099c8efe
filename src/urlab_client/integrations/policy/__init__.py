"""Policies from ONNX files: a network, a TOML file that declares its inputs and outputs, and running it on a robot.

Running a network needs the extra `onnx`. Declarations, mappings and policies made from your own callables do not.
"""

from urlab_client.integrations.policy.evaluation import (
    Estimate,
    Evaluation,
    Outcome,
    bootstrap_mean,
    evaluate_in,
    evaluate_on,
    joined,
    wilson,
)
from urlab_client.integrations.policy.export import PolicyExportError, export_policy
from urlab_client.integrations.policy.mapping import PolicyMapping, PolicyMismatch, RobotState
from urlab_client.integrations.policy.network import (
    Network,
    OnnxDictNetwork,
    OnnxInputs,
    OnnxNetwork,
    PicturesNetwork,
    task_network,
)
from urlab_client.integrations.policy.policy import Policy, load, policy_files
from urlab_client.integrations.policy.runner import PolicyRun, require, run, run_blocking
from urlab_client.integrations.policy.spec import PolicyFileError, PolicySpec, parse_spec, read_spec

__all__ = [
    "Estimate",
    "Evaluation",
    "Network",
    "OnnxDictNetwork",
    "OnnxInputs",
    "OnnxNetwork",
    "Outcome",
    "PicturesNetwork",
    "Policy",
    "PolicyExportError",
    "PolicyFileError",
    "PolicyMapping",
    "PolicyMismatch",
    "PolicyRun",
    "PolicySpec",
    "RobotState",
    "bootstrap_mean",
    "evaluate_in",
    "evaluate_on",
    "export_policy",
    "joined",
    "load",
    "parse_spec",
    "policy_files",
    "read_spec",
    "require",
    "run",
    "run_blocking",
    "task_network",
    "wilson",
]
