"""Axes and text of map pictures, drawn without fonts or libraries that have to be installed."""
