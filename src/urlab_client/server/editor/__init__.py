"""The simulated editor: the open level, its actors, the viewport and debug drawing."""
