"""Domain randomisation, noise and delay: declared once, for simulated servers, environments and batches.

A `Randomisation` says what varies from episode to episode and by how much; the seed of an episode decides on the
numbers, which are the same wherever it runs.
"""

from urlab_client.randomise.declaration import (
    CameraLatency,
    Delay,
    Noise,
    Push,
    Randomisation,
    UnsupportedRandomisation,
    Vary,
)

__all__ = ["CameraLatency", "Delay", "Noise", "Push", "Randomisation", "UnsupportedRandomisation", "Vary"]
