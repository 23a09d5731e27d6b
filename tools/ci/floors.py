"""Coverage floors: ``python -m tools.ci.floors`` reads the data of the last test run and fails below a floor.

Rooms where every byte comes from outside (codecs, registers, configuration) have high floors of their own. Compiled
kernels are invisible to coverage, so they are run once more with the JIT switched off on small inputs.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

WHOLE = 85.0
FLOORS = {
    "hal/hokuyo/scip.py": 95.0,
    "hal/hokuyo/ticks.py": 95.0,
    "hal/net/inputs.py": 90.0,
    "hal/bus/i2c_frames.py": 95.0,
    "hal/photodiode/block_check.py": 95.0,
    "hal/photodiode/driver.py": 95.0,
    "daemon/config/schema.py": 95.0,
    "daemon/integrity/state_machine.py": 95.0,
    "daemon/integrity/state_memory.py": 95.0,
    "daemon/publish/modbus/registers.py": 95.0,
    "daemon/publish/modbus/lights_block.py": 95.0,
    "daemon/devices/sample_clock.py": 90.0,
    "daemon/integrity/lamp_monitor.py": 90.0,
}
"""Per cent of lines and branches, by file."""


def measured() -> tuple[float, dict[str, float]]:
    """Coverage of the whole and by file, from the ``.coverage`` data in the current folder."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "coverage.json"
        command = [sys.executable, "-m", "coverage", "json", "-q", "-o", str(out)]
        subprocess.run(command, check=True)
        report = json.loads(out.read_text())
    files = {name: entry["summary"]["percent_covered"] for name, entry in report["files"].items()}
    return report["totals"]["percent_covered"], files


def shortfalls(whole: float, files: dict[str, float]) -> list[str]:
    """What lies below its floor, one line each; a file with a floor that was not measured at all counts."""
    lines = [] if whole >= WHOLE else [f"whole: {whole:.1f} % < {WHOLE} %"]
    for name, floor in FLOORS.items():
        value = files.get(name, 0.0)
        if value < floor:
            lines.append(f"{name}: {value:.1f} % < {floor} %")
    return lines


def main() -> int:
    """Print the shortfalls; exit status 1 if there are any."""
    whole, files = measured()
    print(f"coverage {whole:.1f} % of lines and branches (floor {WHOLE} %)")
    lines = shortfalls(whole, files)
    for line in lines:
        print(line)
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
