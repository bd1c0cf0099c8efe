"""Writes a LeRobot dataset while its frames arrive. Runs in an interpreter with LeRobot, but without this project.

It imports nothing of this project. Its only argument is a folder with `plan.json`. Each line of standard input names a
file of frames in that folder, and whether they end an episode. It deletes each file when its frames are in the dataset.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np


def main(work: Path) -> None:
    """Write the dataset that `work/plan.json` describes, from the frames that standard input names."""
    plan: dict[str, Any] = json.loads((work / "plan.json").read_text(encoding="utf-8"))
    dataset: Any = None
    for line in sys.stdin:
        order: dict[str, Any] = json.loads(line)
        file = work / order["file"]
        with np.load(file, allow_pickle=False) as arrays:
            frames: dict[str, Any] = {name: arrays[name] for name in arrays.files}
        if dataset is None:
            dataset = _create(plan, frames)
        _add(dataset, plan, frames)
        if order["ends_episode"]:
            dataset.save_episode()
        file.unlink()
    if hasattr(dataset, "finalize"):
        dataset.finalize()


def _create(plan: dict[str, Any], frames: dict[str, Any]) -> Any:
    library: Any = importlib.import_module("lerobot.datasets.lerobot_dataset")

    vectors = {"observation.state": plan["state"], "action": plan["action"]}
    if plan["goal"]:
        vectors["observation.environment_state"] = plan["goal"]
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": (len(names),), "names": names} for key, names in vectors.items()
    }
    features |= {f"next.{name}": {"dtype": kind, "shape": (1,), "names": None} for name, kind in plan["next"].items()}
    for i, name in enumerate(plan["cameras"]):
        features[f"observation.images.{name}"] = {
            "dtype": "video" if plan["video"] else "image",
            "shape": frames[f"pictures{i}"].shape[1:],
            "names": ["height", "width", "channels"],
        }
    return library.LeRobotDataset.create(
        repo_id=f"local/{plan['name']}",
        root=Path(plan["folder"]),
        fps=plan["fps"],
        features=features,
        robot_type=plan["robot_type"],
        use_videos=plan["video"],
    )


def _add(dataset: Any, plan: dict[str, Any], frames: dict[str, Any]) -> None:
    for row in range(len(frames["state"])):
        frame: dict[str, Any] = {
            "observation.state": frames["state"][row],
            "action": frames["action"][row],
            "task": plan["task"],
            **{f"next.{name}": frames[name][row : row + 1] for name in plan["next"]},
        }
        if plan["goal"]:
            frame["observation.environment_state"] = frames["goal"][row]
        for i, name in enumerate(plan["cameras"]):
            frame[f"observation.images.{name}"] = frames[f"pictures{i}"][frames[f"picture{i}"][row]]
        dataset.add_frame(frame)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
