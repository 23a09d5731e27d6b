"""The web page: serves the local stream, or a recording, to browsers."""
