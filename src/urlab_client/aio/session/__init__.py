"""The session with a server: turns, deadlines, claims, jobs."""
