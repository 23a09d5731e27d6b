"""Explanations of what the joint fit leaves over: twins of one code, slow lamps, saturation, regular pauses."""
