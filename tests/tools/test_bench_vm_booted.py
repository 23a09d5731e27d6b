"""A computer that is booted once for its image: what is kept of it, how a run goes on, and QEMU's command line."""

from __future__ import annotations

import shutil
import subprocess
import threading
from pathlib import Path

import pytest

from tools.bench.vm import booted, image, places
from tools.bench.vm.machine import Machine, Ports, command_line


def test_the_disk_is_never_written_to_and_only_loopback_is_listened_on(tmp_path: Path) -> None:
    kept = booted.Booted(image.Image(tmp_path), tmp_path / "it's")
    words = command_line(kept.start, tmp_path, Ports(1, 2, 3))
    assert any(f"file={kept.disk}," in word and "snapshot=on" in word for word in words)
    assert words[-2:] == ["-incoming", f"exec:cat '{tmp_path}/it'\"'\"'s/memory'"]
    forwards = [part for word in words for part in word.split(",") if part.startswith("hostfwd=")]
    assert len(forwards) == 3
    assert all(":127.0.0.1:" in forward for forward in forwards)


@pytest.mark.skipif(shutil.which(booted.QEMU) is None, reason="no qemu-system-x86")
def test_a_computer_goes_on_from_what_was_kept_of_it(tmp_path: Path) -> None:
    """The same QEMU and words, no system inside: it stops, its memory is kept, and another one takes it."""
    words = [booted.QEMU, "-nodefaults", "-no-user-config", "-display", "none", "-machine", "q35", "-m", "16"]

    def machine(name: str, *more: str) -> Machine:
        folder = tmp_path / name
        folder.mkdir()
        process = subprocess.Popen([*words, "-qmp", f"unix:{folder / 'qmp'},server=on,wait=off", *more])
        (folder / "qemu").touch()
        return Machine(process, folder, Ports(1, 2, 3), threading.Event())

    first = machine("first")
    try:
        first.keep(tmp_path / "its memory")
    finally:
        first.stop()
    second = machine("second", "-incoming", f"exec:cat '{tmp_path}/its memory'")
    try:
        second._until_status("paused", "taking it")
        second._monitor("cont")
        second._until_status("running", "going on")
    finally:
        second.stop()
    third = machine("third", "-incoming", "exec:head -c 9000 /dev/urandom")
    with pytest.raises(places.CannotBench, match=r"QEMU (has ended|does not)"):
        third._until_status("paused", "taking what is no memory")
    third.stop()


def test_kernels_are_compiled_outside_with_the_settings_that_are_set_inside() -> None:
    inside = (image.GUEST / "generic.conf").read_text().partition("Environment=")[2].split()
    assert dict(word.split("=") for word in inside) == {k: v for k, v in image.WARM.items() if k.startswith("NUMBA")}


def test_what_was_kept_is_of_one_qemu_and_one_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(booted, "QEMU", "echo")
    made = image.Image(tmp_path)
    key = booted._key(made)
    assert key == booted._key(made)
    (tmp_path / f"booted-{key}").mkdir()
    (tmp_path / f"booted-{key}" / "told.json").write_text('{"seconds": 12.5}')
    assert booted.booted(made, print).seconds == 12.5
    monkeypatch.setattr(booted, "command_line", lambda *given: [*command_line(*given), "-no-hpet"])
    assert booted._key(made) != key
    monkeypatch.setattr(booted, "QEMU", "true")
    assert booted._key(made) != key


def test_a_computer_that_does_not_come_up_leaves_nothing_half_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what was kept of another QEMU goes."""

    def ends(*given: object) -> float:
        raise places.CannotBench("it does not boot")

    monkeypatch.setattr(booted, "QEMU", "echo")
    monkeypatch.setattr(booted, "_boot", ends)
    (tmp_path / "booted-old").mkdir()
    with pytest.raises(places.CannotBench, match="it does not boot"):
        booted.booted(image.Image(tmp_path), lambda text: None)
    assert list(tmp_path.iterdir()) == []
