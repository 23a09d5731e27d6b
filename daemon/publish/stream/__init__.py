"""The local stream: a unix socket with msgpack frames for processes beside the daemon; server, client, messages."""
