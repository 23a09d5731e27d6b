"""Import of maps of ROS map_server and nav2: a YAML description and an image, converted to trinary cells."""

from daemon.maps.map_server.cells import Trinary, cells_of, load
from daemon.maps.map_server.description import FREE, OCCUPIED, BadMapServer, Description, describe

__all__ = ["FREE", "OCCUPIED", "BadMapServer", "Description", "Trinary", "cells_of", "describe", "load"]
