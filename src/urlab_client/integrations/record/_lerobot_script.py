"""Writes a LeRobot dataset from a prepared folder. Run by an interpreter that has LeRobot, which has none of ours.

It imports nothing of this project, and is given the folder as its only argument.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

__all__ = ["main"]


def main(work: Path) -> None:
    """Write the dataset that `work/plan.json` describes."""
    library: Any = importlib.import_module("lerobot.datasets.lerobot_dataset")

    plan: dict[str, Any] = json.loads((work / "plan.json").read_text(encoding="utf-8"))
    arrays: Any = np.load(work / "states.npz", allow_pickle=False)
    cameras: list[str] = plan["cameras"]
    features: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": (len(plan["state"]),), "names": plan["state"]},
        "action": {"dtype": "float32", "shape": (len(plan["action"]),), "names": plan["action"]},
    }
    if plan["goal"]:
        features["observation.environment_state"] = {
            "dtype": "float32",
            "shape": (len(plan["goal"]),),
            "names": plan["goal"],
        }
    for i, name in enumerate(cameras):
        shape = np.array(Image.open(work / str(i) / "0.png")).shape
        features[f"observation.images.{name}"] = {
            "dtype": "video" if plan["video"] else "image",
            "shape": shape,
            "names": ["height", "width", "channels"],
        }
    folder = Path(plan["folder"])
    dataset: Any = library.LeRobotDataset.create(
        repo_id=f"local/{folder.name}",
        root=folder,
        fps=plan["fps"],
        features=features,
        robot_type=plan["robot_type"],
        use_videos=plan["video"],
    )
    episodes = arrays["episode"]
    for row in range(len(episodes)):
        frame: dict[str, Any] = {
            "observation.state": arrays["state"][row],
            "action": arrays["action"][row],
            "task": plan["task"],
        }
        if plan["goal"]:
            frame["observation.environment_state"] = arrays["goal"][row]
        for i, name in enumerate(cameras):
            picture = work / str(i) / f"{arrays[f'picture{i}'][row]}.png"
            frame[f"observation.images.{name}"] = np.array(Image.open(picture))
        dataset.add_frame(frame)
        if row + 1 == len(episodes) or episodes[row + 1] != episodes[row]:
            dataset.save_episode()
    if hasattr(dataset, "finalize"):
        dataset.finalize()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
