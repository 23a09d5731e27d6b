"""Where a HOKUYO may be plugged in, and what kind of line a device name stands for."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final

USB_VENDOR: Final = "15d1"  # HOKUYO AUTOMATIC, `URG-Series USB Driver`
_DEV: Final = Path("/dev")
_SYS_TTY: Final = Path("/sys/class/tty")
_RS232: Final = re.compile(r"tty(USB|S|AMA|THS|mxc|SC|O|PS|XRUSB)\d+$")


def candidates() -> list[str]:
    """Device files to try for ``auto``, most likely first, each real device once.

    The stable name made by the udev rule, then ports whose USB vendor is HOKUYO, then serial adapters. A CDC-ACM port
    that names another vendor is left alone: it is somebody else's microcontroller. Whatever is behind a serial adapter
    gets to hear a QT at every line rate; where it must not, name the sensor's device file instead of ``auto``.
    """
    found = [
        *_existing(_DEV / "lumiloop", "lidar"),
        *_existing(_DEV / "serial" / "by-path", "*"),
        *_existing(_DEV, "ttyACM*"),
        *_existing(_DEV, "ttyUSB*"),
    ]
    unique: dict[Path, str] = {}
    for path in found:
        unique.setdefault(path.resolve(), str(path))
    ranked = [(rank, name) for real, name in unique.items() if (rank := _rank(real)) is not None]
    return [name for _, name in sorted(ranked, key=lambda entry: entry[0])]


def _existing(folder: Path, pattern: str) -> Iterable[Path]:
    return sorted(folder.glob(pattern)) if folder.is_dir() else []


def _rank(real: Path) -> int | None:
    """0: certainly ours. 1: cannot tell. None: certainly not."""
    vendor = usb_vendor(real.name)
    if vendor == USB_VENDOR:
        return 0
    if real.name.startswith("ttyACM") and vendor:
        return None
    return 1


def usb_vendor(tty: str) -> str:
    """USB vendor of ``ttyACM0`` in lower-case hex; empty where sysfs does not say."""
    device = _SYS_TTY / tty / "device"
    if not device.exists():
        return ""
    for folder in (device.resolve(), *device.resolve().parents[:3]):
        try:
            return (folder / "idVendor").read_text().strip().lower()
        except OSError:
            continue
    return ""


def is_rs232(device: str, baud: int = 0) -> bool:
    """True where the line rate matters: a UART or a USB-to-serial adapter, also behind a symbolic link.

    Whatever else has a ``baud`` that somebody has written behind its name is taken for a line, too (a pseudo-terminal,
    an adapter whose driver has a name of its own); USB CDC-ACM and Ethernet have no rate, whatever is written.
    """
    if not device.startswith("/"):
        return False
    name = Path(device).resolve().name
    return _RS232.match(name) is not None or (baud > 0 and not name.startswith("ttyACM"))
