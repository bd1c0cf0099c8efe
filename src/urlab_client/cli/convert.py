"""`urlab convert`: convert a recording to a table, arrays, a video or a LeRobot dataset.

Convert a recording. CSV, Parquet and LeRobot files hold states with the actions taken at them, NumPy files all states,
and MP4 files the pictures of one camera. Needs the extra 'urlab-client[mcap]', for Parquet also 'dataset', and for MP4
also 'video'.
"""

from __future__ import annotations

from argparse import Namespace
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from urlab_client.cli._arguments import RECORDING
from urlab_client.cli._common import CommandError, progress_bar, refusing, sigterm_interrupts

if TYPE_CHECKING:
    from urlab_client.integrations.record import Run

_FORMATS = ("csv", "npz", "parquet", "mp4", "lerobot")
_PAIRS = "rows: states, with the actions that followed"

USAGE = f"""
{RECORDING}
OUTPUT  the file to write; its ending selects the format
--format {"|".join(_FORMATS)}  the format, if the ending does not select it
--camera NAME...  a camera, as ARTICULATION/CAMERA: for mp4 the one to show, for npz and lerobot those to add; may be
    repeated
--episodes kept|success|all=kept  which marked episodes to write to tables and LeRobot datasets: those that were not
    discarded, successes, or all
--overwrite  replace OUTPUT if it exists; a folder only if it is empty or a LeRobot dataset
LeRobot datasets:
--fps N  frames per second (default: the rate of the pictures or states)
--task TEXT=  what the robot does
--robot-type TEXT  kind of robot (default: the articulations' names)
--images  store pictures as PNG files instead of video
--max-picture-age SECONDS  how much older than its state a picture may be (default: one frame)
--python INTERPRETER  a Python interpreter that has LeRobot; this one does not need it
examples:
urlab convert run.mcap run.csv  states as a table
urlab convert run.mcap run.mp4 --camera arm/overview  the pictures of one camera as a video
urlab convert run.mcap run.npz --camera arm/wrist  states and pictures as NumPy arrays
"""


def run(arguments: Namespace) -> int:
    """Convert."""
    kind = arguments.format or arguments.output.suffix[1:].lower()
    if kind not in _FORMATS:
        raise CommandError(f"{arguments.output}: name the format with --format {'|'.join(_FORMATS)}, or by the ending")
    if arguments.output.exists() and not arguments.overwrite:
        raise CommandError(f"{arguments.output} exists; --overwrite replaces it")
    from urlab_client.integrations.record import read_run

    left_out: Counter[str] = Counter()
    with refusing(KeyError, FileExistsError):
        recording = read_run(arguments.recording)
        write, what = _writer(kind, recording, arguments, left_out)
        shown = progress_bar(f"{arguments.recording.name} → {kind}", recording.path.stat().st_size)
        with sigterm_interrupts(), shown as progress:
            written = write(arguments.output, progress=progress)
    print(f"{arguments.output}  {written} {what}")
    for reason, count in left_out.items():
        if count:
            print(f"left out: {count} {'pair' if count == 1 else 'pairs'} of a state and an action {reason}")
    if recording.damage:
        print(
            f"{arguments.recording} is unfinished or damaged; everything before that was written ({recording.damage})"
        )
    return 0


def _writer(kind: str, recording: Run, arguments: Namespace, left_out: Counter[str]) -> tuple[Callable[..., int], str]:
    from urlab_client.integrations.record import export

    cameras = arguments.camera
    pairs: dict[str, Any] = {"episodes": arguments.episodes, "left_out": left_out}
    match kind:
        case "csv":
            return partial(export.write_csv, recording, **pairs), _PAIRS
        case "parquet":
            return partial(export.write_parquet, recording, **pairs), _PAIRS
        case "npz":
            return partial(export.write_npz, recording, cameras=cameras), "states"
        case "mp4":
            if len(cameras) != 1:
                there = cameras or recording.cameras()
                if not there:
                    raise CommandError(f"{arguments.recording} has no pictures; `urlab record --camera` records them")
                if cameras or len(there) != 1:
                    raise CommandError(f"a video shows one camera: give one --camera; there are {', '.join(there)}")
                cameras = there
            return partial(export.write_mp4, recording, camera=cameras[0]), "pictures"
        case _:
            if not arguments.task or not arguments.python:
                raise CommandError(
                    "a LeRobot dataset needs --task TEXT, and --python INTERPRETER of an interpreter that has LeRobot"
                )
            return partial(
                export.write_lerobot,
                recording,
                python=arguments.python,
                fps=arguments.fps,
                task=arguments.task,
                robot_type=arguments.robot_type,
                video=not arguments.images,
                max_picture_age=arguments.max_picture_age,
                overwrite=arguments.overwrite,
                cameras=cameras or None,
                **pairs,
            ), "frames"
