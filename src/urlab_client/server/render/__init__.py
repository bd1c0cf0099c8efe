"""Pictures: the robots' cameras and the viewport."""
