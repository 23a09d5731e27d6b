"""The web page: a process of its own that shows the local stream, or a recording, to browsers."""
