"""Recording runs as MCAP files that Foxglove opens, reading them, and converting them.

Requires the extra `mcap`; some conversions require `video` or `dataset`.
"""

from urlab_client._installation import need

need("mcap", "PIL", extra="mcap")

from urlab_client.integrations._feed.messages import EpisodeOutcome  # noqa: E402
from urlab_client.integrations.record.contents import (  # noqa: E402
    Camera,
    RecordedArticulation,
    RecordedEntity,
    RecordedState,
    Summary,
    Table,
    Topic,
)
from urlab_client.integrations.record.reader import Run, read_run  # noqa: E402
from urlab_client.integrations.record.recorder import AsyncRecorder, Recorder, record  # noqa: E402
from urlab_client.integrations.record.transitions import Episodes, transitions, transitions_of  # noqa: E402
from urlab_client.integrations.record.writer import RecorderStats, RecordingError  # noqa: E402

__all__ = [
    "AsyncRecorder",
    "Camera",
    "EpisodeOutcome",
    "Episodes",
    "RecordedArticulation",
    "RecordedEntity",
    "RecordedState",
    "Recorder",
    "RecorderStats",
    "RecordingError",
    "Run",
    "Summary",
    "Table",
    "Topic",
    "read_run",
    "record",
    "transitions",
    "transitions_of",
]
