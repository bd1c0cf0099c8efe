"""`urlab info`: show what is in a recording.

Show duration, topics, rates and gaps of a recording. Exit code 0, or 1 if the file is unfinished or damaged, or states
were dropped. Needs the extra 'urlab-client[mcap]'.
"""

from __future__ import annotations

from argparse import Namespace
from collections import Counter
from typing import TYPE_CHECKING

from urlab_client.cli._arguments import RECORDING
from urlab_client.cli._common import aligned, counted, json_line, progress_bar

if TYPE_CHECKING:
    from urlab_client.integrations.record import Summary

_UNFINISHED = 1

USAGE = f"""
{RECORDING}
--json  print JSON
--verify  read the whole file and compare checksums, not only its index
examples:
urlab info run.mcap  duration, topics, rates and gaps
urlab info run.mcap --json  the same for programs
urlab info run.mcap --verify  also look for damage
"""


def run(arguments: Namespace) -> int:
    """Print the summary; return 0 for a complete recording, else 1."""
    from urlab_client.integrations.record import read_run

    recording = read_run(arguments.recording)
    with progress_bar(arguments.recording.name, recording.path.stat().st_size) as progress:
        summary = recording.summary(progress, verify=arguments.verify)
    if arguments.json:
        print(json_line(summary))
    else:
        _print(summary)
    return 0 if summary.complete and not (summary.dropped_states or summary.dropped_frames) else _UNFINISHED


def _print(summary: Summary) -> None:
    about = summary.about
    print(f"{summary.path}  {summary.path.stat().st_size / 2**20:.1f} MiB")
    print(
        f"{about.get('started', '?')}  {about.get('address', '?')}  {about.get('step_mode', '?')} mode  "
        f"server {about.get('urlab_version', '?')}, MuJoCo {about.get('mujoco_version', '?')}"
    )
    print(f"{summary.duration_s:.3f} s simulated in {summary.wall_s:.3f} s, {counted(summary.episodes, 'episode')}")
    if not summary.complete:
        print(f"not finished, or damaged: {summary.damage}")
    if summary.dropped_states or summary.dropped_frames:
        print(
            f"dropped: {counted(summary.dropped_states, 'state')}, {counted(summary.dropped_frames, 'picture')}, "
            "which arrived faster than the file could be written"
        )
    if summary.outcomes:
        counts = Counter(mark.outcome for mark in summary.outcomes)
        unmarked = summary.episodes - len(summary.outcomes)
        print("outcomes: " + ", ".join(f"{n} {what}" for what, n in (*counts.items(), ("unmarked", unmarked)) if n))
    _print_varied(summary)
    rows = [("topic", "schema", "messages", "rate (Hz)", "gaps", "longest (s)")]
    for topic in summary.topics.values():
        rate = f"{topic.rate_hz:.1f}" if topic.rate_hz else ""
        longest = f"{topic.longest_gap_s:.3f}" if topic.longest_gap_s else ""
        rows.append((topic.name, topic.schema, str(topic.messages), rate, str(topic.gaps), longest))
    print(aligned(rows, right=range(2, 6)))
    for robot, names in summary.positions.items():
        print(f"positions of {robot}: {', '.join(names)}")


def _print_varied(summary: Summary) -> None:
    """Print what varied between episodes, and how much."""
    spans: dict[tuple[str, str], list[float]] = {}
    elements: dict[tuple[str, str], set[str]] = {}
    for episode in summary.varied:
        for quantity in episode.varied:
            key = quantity.what, quantity.by
            spans.setdefault(key, []).extend(value for row in quantity.drawn.values() for value in row)
            elements.setdefault(key, set()).update(quantity.drawn)
    for (what, by), values in spans.items():
        where = counted(len(elements[what, by]), "element")
        if values:
            print(f"varied: {what}, {by} {min(values):.4g} to {max(values):.4g} on {where}")
