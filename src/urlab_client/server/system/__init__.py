"""What the server needs from the operating system: threads, memory, temporary folders."""
