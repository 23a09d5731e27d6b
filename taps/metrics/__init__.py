"""Prometheus metrics and the VDA 5050 position object over HTTP."""
