"""Sources of published data for the streams: states, pictures and events."""
