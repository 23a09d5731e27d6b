"""Inside the virtual machine: carries out the bench's orders, and is the wire of its two fake devices.

Not part of the daemon, which meets only a real /dev/ttyACM0 and a real /dev/i2c-N:

* what the bench's simulator says as a lidar comes in by a virtio port and goes out of the gadget side of a USB serial
  line (/dev/ttyGS0), whose host side is /dev/ttyACM0;
* transactions of the adapter `fakei2c` are carried out on the simulator's own bus, over TCP.

Orders are JSON objects, one a line, on the virtio port `bench.agent`; each is answered by one line that has its number:
{"id": 7, "run": [words], "seconds": 60} by {"id": 7, "code": 0, "out": "..."}; {"write": path, "text": "..."};
{"i2c": "tcp://host:port"}.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import select
import signal
import struct
import subprocess
import threading
import time
import tty
from pathlib import Path

PORTS = Path("/dev/virtio-ports")
GADGET, WIRE = "/dev/ttyGS0", "/dev/fakei2c"
PIECE = 4096
PATIENCE_S = 0.2
HEAD, MESSAGE = struct.Struct("=Ii"), struct.Struct("=HHHH")
READ = 1
ADAPTER_S = 1.0


def opened(path: str) -> int:
    """A device node, once it is there and can be opened."""
    while True:
        try:
            return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_NOCTTY)
        except OSError:
            time.sleep(0.05)


def hand_over(source: int, sink: int) -> None:
    """What is there, from one to the other; what the other does not take is lost, as on a line that nobody reads.

    Raises:
        OSError: the line has been hung up, or its far end is not there.
    """
    try:
        data = os.read(source, PIECE)
    except BlockingIOError:
        return
    if not data:
        raise OSError(errno.EIO, "hung up")
    while data and select.select([], [sink], [], PATIENCE_S)[1]:
        with contextlib.suppress(BlockingIOError):
            data = data[os.write(sink, data) :]


def carry_lidar() -> None:
    """For ever: bytes between the simulated lidar and the gadget."""
    while True:
        sensor, gadget = opened(str(PORTS / "bench.lidar")), opened(GADGET)
        try:
            tty.setraw(gadget)
            while True:
                for ready in select.select([sensor, gadget], [], [])[0]:
                    hand_over(ready, gadget if ready == sensor else sensor)
        except OSError:
            time.sleep(0.05)  # the cable is being pulled
        finally:
            os.close(sensor)
            os.close(gadget)


def transaction(data: bytes) -> tuple[int, list[tuple[int, bytes, int]]]:
    """Number and messages (address, bytes to write, bytes to read) of what the adapter wants."""
    number, count = HEAD.unpack_from(data)
    at = HEAD.size + count * MESSAGE.size
    messages = []
    for k in range(count):
        address, flags, length, _ = MESSAGE.unpack_from(data, HEAD.size + k * MESSAGE.size)
        if flags & READ:
            messages.append((address, b"", length))
        else:
            messages.append((address, data[at : at + length], 0))
            at += length
    return number, messages


def carry_i2c(name: str) -> None:
    """For ever: transactions of the adapter, on the bench's bus of that name."""
    from hal.bus.i2c import Bus, Message
    from hal.bus.i2c_remote import open_remote

    bus: Bus | None = None
    wire = os.open(WIRE, os.O_RDWR)
    while True:
        number, wanted = transaction(os.read(wire, 65536))
        begun, result, answer = time.monotonic(), 0, b""
        try:
            bus = bus or open_remote(name)
            done = bus.transfer(tuple(Message(*message) for message in wanted))
            answer = b"".join(done.reads)
        except OSError as error:
            result = -(error.errno or errno.EIO)
        except Exception:  # noqa: BLE001  whatever is wrong with the bench's bus, this machine's has no answer
            bus, result = None, -errno.ENXIO
        if time.monotonic() - begun < ADAPTER_S:
            try:
                os.write(wire, HEAD.pack(number, result) + answer)
            except OSError:  # the adapter has given up waiting
                continue


def run(words: list[str], seconds: float) -> dict[str, object]:
    """A command with everything that it starts; all of that ends when its time is over, and so nobody waits for it."""
    try:
        child = subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            errors="replace", start_new_session=True,
        )  # fmt: skip
    except OSError as error:
        return {"code": 127, "out": str(error)}
    try:
        said, _ = child.communicate(timeout=seconds)
    except subprocess.TimeoutExpired as error:
        os.killpg(child.pid, signal.SIGKILL)
        child.communicate()
        return {"code": 127, "out": str(error)}
    return {"code": child.returncode, "out": said}


def write_all(port: int, data: bytes) -> None:
    """A virtio port takes no more than 32 KB at once, and says how much of it."""
    while data:
        data = data[os.write(port, data) :]


def obey(order: dict[str, object]) -> dict[str, object]:
    """Carry out one order."""
    if "run" in order:
        words = [str(word) for word in order["run"]]  # type: ignore[attr-defined]  # as the bench sends it
        return run(words, float(str(order.get("seconds", 60))))
    if "write" in order:
        path = Path(str(order["write"]))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(str(order["text"]))
        return {"code": 0, "out": ""}
    if "i2c" in order:
        threading.Thread(target=carry_i2c, args=(str(order["i2c"]),), daemon=True).start()
        return {"code": 0, "out": ""}
    return {"code": 126, "out": f"unknown order {order}"}


def main() -> None:
    """For ever: orders."""
    threading.Thread(target=carry_lidar, daemon=True).start()
    with (PORTS / "bench.agent").open("r+b", buffering=0) as port:
        write_all(port.fileno(), b'{"up": true}\n')
        rest = b""
        while True:
            piece = port.read(PIECE)
            if not piece:
                time.sleep(0.02)
                continue
            *lines, rest = (rest + piece).split(b"\n")
            for line in lines:
                order = json.loads(line)
                answer = {"id": order.get("id"), **obey(order)}
                write_all(port.fileno(), json.dumps(answer).encode() + b"\n")


if __name__ == "__main__":
    main()
