"""Domain randomisation, noise and delay: declared once, for simulated servers, environments and batches.

A `Randomisation` declares what varies between episodes and by how much. The numbers depend only on the seed of the
episode, so they are the same wherever it runs.
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
