"""What surrounds the core in a running process: port, files, threads, journal, logs."""
