"""Groups of commands by use, and two examples of each."""

from __future__ import annotations

from typing import Final, NamedTuple


class Group(NamedTuple):
    """Commands of one use; ``text``: what they are for."""

    title: str
    text: str
    commands: tuple[str, ...]


GROUPS: Final = (
    Group(
        "Start", "try it without hardware, find sensors, configure, run", ("demo", "probe", "config", "check", "run")
    ),
    Group("Watch", "show state, pose, lamps, faults and remedies", ("status", "view", "explain", "doctor", "why")),
    Group(
        "Orders",
        "send commands to a running daemon",
        ("set-pose", "relocalise", "reset", "pause", "resume", "save-map", "switch-map"),
    ),
    Group("Maps", "import, draw, align and examine maps", ("map",)),
    Group("Lamps", "plan, survey, calibrate and maintain lamps", ("plan", "survey", "calibrate", "lamps", "codes")),
    Group("Logs", "keep, replay and convert recordings", ("dump", "replay", "convert", "export", "record-mcap")),
    Group("Connect", "connect other programs and other robots", ("ros2", "foxglove", "metrics", "fleet")),
    Group("Tools", "help and installation", ("help", "completion", "man", "warm")),
)

EXAMPLES: Final[dict[str, tuple[tuple[str, str], tuple[str, str]]]] = {
    "demo": (
        ("demo", "drive for 75 s; each sensor fails once"),
        ("demo --kidnap --seconds 120", "move the robot to another position; it finds its pose again"),
    ),
    "probe": (
        ("probe", "list every lidar and converter of this computer"),
        ("probe tcp://192.168.0.10:10940", "ask an Ethernet lidar"),
    ),
    "config": (
        ("config init", "write lumiloop.toml with every key as a comment"),
        ("config set modbus.port=502", "change a value and keep all comments"),
    ),
    "check": (
        ("check", "check the configuration file in use"),
        ("check robot.toml --json", "check another file, with JSON output"),
    ),
    "run": (
        ("run --lidar /dev/ttyACM0", "run with this lidar"),
        ("run --record flight --last 10", "record the last 10 minutes"),
    ),
    "status": (
        ("status --watch", "show the daemon of this computer until interrupted"),
        ("status 192.168.1.20 --json", "read another computer's daemon once"),
    ),
    "view": (
        ("view", "serve the web page at http://127.0.0.1:8090"),
        ("view --bind 0.0.0.0 --write", "for other computers; clients with the token can send commands"),
    ),
    "explain": (
        ("explain fault 302", "meaning and remedy of a fault"),
        ("explain map.folder", "meaning of a configuration key"),
    ),
    "doctor": (
        ("doctor", "check this installation and name the first thing to fix"),
        ("doctor --json", "the same with JSON output"),
    ),
    "why": (
        ("why 21:14:07", "explain that time of the flight recorder"),
        ("why 12.5 drive/ --out why.png", "12.5 s after the start of a recording, with a plot"),
    ),
    "set-pose": (
        ("set-pose 1.5 -2 90", "x 1.5 m, y -2 m, facing 90 degrees from the map's x axis"),
        ("set-pose 0 0 1.57rad --host 192.168.1.20", "the same on another computer, in radians"),
    ),
    "relocalise": (
        ("relocalise", "search the whole map for the robot"),
        ("relocalise --timeout 300", "wait five minutes for the result"),
    ),
    "reset": (
        ("reset", "begin a new map here"),
        ("reset --host 192.168.1.20", "on another computer"),
    ),
    "pause": (
        ("pause", "before a crowd comes or a lift moves the robot"),
        ("pause --host 192.168.1.20", "on another computer"),
    ),
    "resume": (
        ("resume", "use the lidar again"),
        ("resume --host 192.168.1.20:502", "on another computer, at another Modbus port"),
    ),
    "save-map": (
        ("save-map", "before the power is switched off"),
        ("save-map --json", "print the reply as JSON"),
    ),
    "switch-map": (
        ("switch-map 1a2b3c4d", "after a ride in the lift"),
        ("switch-map maps/upstairs.lumimap", "the map of a file"),
    ),
    "dump": (
        ("dump", "store the content of the flight recorder"),
        ("dump --set name=agv7", "for the daemon with that name"),
    ),
    "map": (
        ("map import hall.yaml", "use a map from map_server or Nav2"),
        ("map info hall.lumimap", "print the content of a map file"),
    ),
    "plan": (
        ("plan hall.yaml --height 4", "plan lamps 4 m above the ground"),
        ("plan hall.yaml --survey lights.toml", "assess the lamps that are installed"),
    ),
    "survey": (
        ("survey drive/", "locate the lamps of a recorded drive"),
        ("survey drive/ --height 3.2 --out hall.toml", "with a known height"),
    ),
    "calibrate": (
        ("calibrate drive/", "calibrate lamps and receiver from a drive"),
        ("calibrate drive/ --lidar-mount", "calibrate the position of the lidar on the robot"),
    ),
    "lamps": (
        ("lamps", "list dimming lamps and when to replace them"),
        ("lamps --json", "the same with JSON output"),
    ),
    "codes": (
        ("codes --code 17", "print the chips of one code"),
        ("codes --profile B --format c", "print all codes as a C table"),
    ),
    "replay": (
        ("replay drive/ --out result", "run a recording again"),
        ("replay aces.log.gz --out result --method paper", "with the method of the paper"),
    ),
    "convert": (
        ("convert urg.dat urg.log", "make a log from recorded lidar data"),
        ("convert urg.npz urg.log.gz --all", "keep every beam"),
    ),
    "export": (
        ("export drive/ --mcap drive.mcap", "as ROS 2 messages"),
        ("export drive/ --tum drive.tum", "the trajectory, for evo"),
    ),
    "record-mcap": (
        ("record-mcap drive.mcap", "record until interrupted"),
        ("record-mcap drive.mcap --seconds 600 --force", "for ten minutes, replacing the file"),
    ),
    "ros2": (
        ("ros2", "publish topics through a Zenoh router on this computer"),
        ("ros2 --domain 7 --namespace /agv1", "in another domain and namespace"),
    ),
    "foxglove": (
        ("foxglove", "serve the Foxglove app on this computer"),
        ("foxglove --listen 0.0.0.0:8765", "on all network interfaces"),
    ),
    "metrics": (
        ("metrics", "serve Prometheus on this computer"),
        ("metrics --listen 0.0.0.0:9464", "on all network interfaces"),
    ),
    "fleet": (
        ("fleet --watch", "show all robots until interrupted"),
        ("fleet join --router 10.0.0.5:7447", "publish this robot's pose to the fleet"),
    ),
    "help": (
        ("help set-pose", "print options and examples of a command"),
        ("help all", "print one line for each command"),
    ),
    "completion": (
        ("completion bash", "print the script for bash"),
        ("completion fish", "print the script for fish"),
    ),
    "man": (
        ("man", "print the man page of the program"),
        ("man --out man1", "write a page for every command into a folder"),
    ),
    "warm": (
        ("warm", "compile the kernels before the first start"),
        ("warm --config robot.toml", "compile those that this configuration needs"),
    ),
}
"""Command line (without ``lumiloop``) and what it does, two for each command."""
