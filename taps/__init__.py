"""Taps: processes of their own that listen to the daemon's local stream and pass on what it tells in other forms.

Nothing of the daemon imports this room, and none of them runs in its process: a tap that hangs or crashes costs it a
buffer. Libraries that only a tap needs are extras; `daemon.cli.parser` says which one is
missing.
"""
