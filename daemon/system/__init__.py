"""Operating system services for the daemon: files, logging, service manager, scheduling, versions."""
