"""What confines a process that compiles a stranger's model."""
