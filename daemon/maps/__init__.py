"""Stored maps: container, schema, store, autosave, last pose, and import and export formats."""
