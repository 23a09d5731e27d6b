"""Search for device files behind which a HOKUYO may be, and the kind of line behind a device name."""

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

    The order is: the stable name of the udev rule, ports whose USB vendor is HOKUYO, serial adapters. A CDC-ACM port of
    another vendor is left out: it belongs to some other microcontroller. The device behind a serial adapter receives a
    QT at every line rate; where it must not, name the sensor's device file instead of ``auto``.
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
    """0: a HOKUYO. 1: may be one. None: another device."""
    vendor = usb_vendor(real.name)
    if vendor == USB_VENDOR:
        return 0
    if real.name.startswith("ttyACM") and vendor:
        return None
    return 1


def usb_vendor(tty: str) -> str:
    """USB vendor of ``ttyACM0`` in lower-case hex; empty where sysfs does not give it."""
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

    Any other device with a configured ``baud`` counts as a line, too (a pseudo-terminal, an adapter with an unusual
    driver name). USB CDC-ACM and Ethernet never have a rate.
    """
    if not device.startswith("/"):
        return False
    name = Path(device).resolve().name
    return _RS232.match(name) is not None or (baud > 0 and not name.startswith("ttyACM"))
