"""The client's copy of the model: loading it, its elements by name, and each articulation's mirrored state."""
