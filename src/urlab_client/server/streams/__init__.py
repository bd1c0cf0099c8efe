"""What the server publishes without being asked: states, rows and camera pictures."""
