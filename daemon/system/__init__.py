"""What the daemon needs of the operating system: files, logging, the service manager, scheduling, versions."""
