"""Device adapters of the daemon; `conversion` is the only place where device units become SI."""
