"""`lumiloop codes`: its tables against the simulator's (built another way), and against what a C compiler reads."""

import csv
import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.cli import parser
from daemon.system import console
from tools.sim.light.transmitter import Lamp, code_bits

ROOT = Path(__file__).parents[3]
DEGREES = {"A": 7, "B": 6, "D": 9}


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert parser.main(["codes", *words]) == console.OK
    return capsys.readouterr().out


def chips(profile: str, code: int) -> str:
    return "".join(map(str, code_bits(DEGREES[profile], code)))


def light(profile: str, code: int) -> str:
    """Half chips of one code period as the simulated lamp sends them."""
    lamp = Lamp(code=code, current_a=1.0, depth=0.5, data=False)
    degree = DEGREES[profile]
    levels = [lamp.edges(k - 0.25, k + 0.25, 0.5, degree)[1][0] for k in range(2 ** (degree + 1) - 2)]
    return "".join("1" if level > 1.0 else "0" for level in levels)


@pytest.mark.parametrize("profile", ["A", "B", "D"])
def test_csv_of_all_codes(profile: str, capsys: pytest.CaptureFixture[str]) -> None:
    rows = list(csv.DictReader(io.StringIO(printed(capsys, "--profile", profile))))
    assert [int(row["code"]) for row in rows] == list(range(2 ** DEGREES[profile] + 1))
    for row in rows[:: 1 if profile != "D" else 19]:
        assert row["chips"] == chips(profile, int(row["code"]))
    for row in (rows[0], rows[-1]):
        assert row["half_chips"] == light(profile, int(row["code"]))


def test_json_of_one_code(capsys: pytest.CaptureFixture[str]) -> None:
    facts = json.loads(printed(capsys, "--code", "128", "--format", "json"))
    assert (facts["profile"], facts["length"], facts["depth"]) == ("A", 127, 0.3)
    assert facts["half_chip_s"] == pytest.approx(100e-6)
    assert facts["codes"] == [{"code": 128, "chips": chips("A", 128), "half_chips": light("A", 128)}]


@pytest.mark.parametrize("profile", ["A", "B", "D"])
def test_a_c_compiler_reads_the_same_bits(profile: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) on this computer")
    (tmp_path / "codes.h").write_text(printed(capsys, "--profile", profile, "--format", "c"))
    name = f"lumiloop_{profile.lower()}"
    (tmp_path / "show.c").write_text(
        '#include <stdio.h>\n#include "codes.h"\n'
        "static void show(const uint8_t *bits, int count) {\n"
        "    for (int k = 0; k < count; k++) putchar('0' + (bits[k / 8] >> (7 - k % 8) & 1));\n"
        "    putchar(10);\n}\n"
        "int main(void) {\n"
        f"    for (int c = 0; c < {name.upper()}_CODES; c++) {{\n"
        f"        show({name}_chips[c], {name.upper()}_LENGTH);\n"
        f"        show({name}_half_chips[c], 2 * {name.upper()}_LENGTH);\n    }}\n    return 0;\n}}\n"
    )
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run([compiler, *flags, "-o", tmp_path / "show", tmp_path / "show.c"], check=True)
    lines = subprocess.run([tmp_path / "show"], capture_output=True, text=True, check=True).stdout.split()
    rows = list(csv.DictReader(io.StringIO(printed(capsys, "--profile", profile))))
    assert lines == [row[column] for row in rows for column in ("chips", "half_chips")]


@pytest.mark.parametrize("code", ["129", "-1"])
def test_a_code_that_does_not_exist(code: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert parser.main(["codes", "--code", code]) == console.USAGE
    assert capsys.readouterr().err == f"lumiloop: --code {code}: profile A has codes 0 to 128\n"


def test_the_profiles_offered_are_all_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    from estimator.cdma.air_interface import PROFILES

    assert sorted(PROFILES) == sorted(DEGREES)
    with pytest.raises(SystemExit):
        parser.main(["codes", "--profile", "C"])
    assert "name A, B, D" in capsys.readouterr().err


def test_no_kernel_is_loaded() -> None:
    code = (
        "import sys\nfrom daemon.cli.parser import main\nassert main(['codes']) == 0\nassert 'numba' not in sys.modules"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
