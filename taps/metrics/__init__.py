"""HTTP server of Prometheus metrics and of the VDA 5050 position object."""
