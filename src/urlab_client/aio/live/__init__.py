"""What arrives without being asked for: published states, pictures and events, on their way to streams."""
