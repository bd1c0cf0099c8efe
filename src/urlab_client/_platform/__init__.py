"""What touches the operating system: threads, child processes, signals, files, processors, Windows."""
