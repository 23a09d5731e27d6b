"""Sources and parts of the local stream: recordings replayed as a stream, and the map assembled from its tiles."""
