"""The streams that the server publishes: states, rows and camera pictures."""
