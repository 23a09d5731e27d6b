"""Local stream: a unix socket with msgpack messages for processes beside the daemon; server, client, messages."""
