"""Taps: processes beside the daemon that read its local stream and publish it in other forms.

No module of the daemon imports this room, and no tap runs in its process: a tap that hangs or crashes costs the
daemon a buffer. Libraries that only a tap needs are extras; a command names the missing one. The packages:

* ``view``: the web page. ``ros``: messages and a node of ROS 2. ``foxglove``: a live server. ``mcap``: MCAP files.
* ``metrics``: Prometheus and VDA 5050 over HTTP. ``fleet``: several robots over Zenoh.
* ``stream``: recordings as a stream, and the map assembled from tiles.

Modules of the room itself are shared by the packages: ``access_guard``, ``zenoh_session``.
"""
