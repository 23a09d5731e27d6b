"""What the virtual bench keeps and finds damaged: told, made anew, and where that cannot be what to remove."""

from __future__ import annotations

import socket
import subprocess
import threading
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from tools.bench.vm import booted, image, places, whole
from tools.bench.vm.machine import Machine, Ports

PORTS = Ports(1, 2, 3)


def made(folder: Path) -> image.Image:
    """An image to look at, in a folder of its own."""
    folder.mkdir(parents=True)
    one = image.Image(folder)
    for part in one.parts:
        part.write_bytes(b"x" * 100)
    whole.note(folder, one.parts)
    return one


@pytest.mark.parametrize("small", [10, 1000], ids=["by its first block", "to its end"])
def test_garbage_of_the_same_size_is_found(small: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(whole, "SMALL", small)
    one = made(tmp_path / "image")
    assert one.lacks() == ""
    one.disk.write_bytes(b"y" * 100)
    assert one.lacks() == "disk is not what was made"
    one.kernel.write_bytes(b"x" * 99)
    assert one.lacks() == "disk is not what was made, vmlinux is not what was made"
    one.initrd.write_bytes(b"")
    assert one.lacks() == "no initrd"


@pytest.mark.parametrize("text", [None, "", "[]", "{"])
def test_without_a_list_that_was_written_last_nothing_is_whole(text: str | None, tmp_path: Path) -> None:
    one = made(tmp_path / "image")
    (one.folder / whole.NAME).unlink()
    if text is not None:
        (one.folder / whole.NAME).write_text(text)
    assert one.lacks() == "no readable whole.json"


def test_an_image_that_is_made_has_its_list(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def installs(folder: Path, root: Path, say: object) -> None:
        (root / "boot").mkdir(parents=True)
        for name in ("vmlinuz-6.1.0-amd64", "initrd.img-6.1.0-amd64"):
            (root / "boot" / name).write_bytes(b"x")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(image, "_install", installs)
    monkeypatch.setattr(image, "_compile", lambda say: tmp_path)
    monkeypatch.setattr(image, "plant", lambda root, compiled: None)
    monkeypatch.setattr(image, "unpacked", lambda packed: packed)
    monkeypatch.setattr(image, "_do", lambda *words: "")
    one = image.Image(places.cache() / "image-1")
    image._make_image(tmp_path, one, lambda text: None)
    assert one.lacks() == ""
    assert {path.name for path in one.folder.iterdir()} == {"disk", "vmlinux", "initrd", "whole.json"}


def test_what_may_not_be_removed_is_not_booted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An image that root has made, met by somebody else."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    one = made(places.cache() / f"image-{image.image_key()}")
    one.disk.write_bytes(b"garbage")
    monkeypatch.setattr("tools.bench.vm.places.shutil.rmtree", lambda folder, ignore_errors: None)
    said: list[str] = []
    with pytest.raises(places.CannotBench) as refused, image.image(said.append):
        pass
    text = str(refused.value)
    assert f"{one.folder} is not whole (disk is not what was made), and this user may not remove it" in text
    assert f"remove {one.folder} as its owner or as root" in text
    assert "XDG_CACHE_HOME can name another place" in text
    assert not [line for line in said if "anew" in line]


def ended(folder: Path) -> Machine:
    """One whose QEMU has ended, with a word of its own."""
    (folder / "qemu").write_text("no bootable device")
    process = subprocess.Popen(["false"])
    process.wait()
    return Machine(process, folder, PORTS, threading.Event())


def test_a_first_boot_that_ends_names_the_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = made(tmp_path / "image")
    monkeypatch.setattr("subprocess.run", lambda *words, **named: SimpleNamespace(returncode=0))
    monkeypatch.setattr(booted, "started", lambda *given: nullcontext(ended(tmp_path)))
    with pytest.raises(places.CannotBench) as refused:
        booted._boot(tmp_path, booted.Booted(one, tmp_path))
    assert "QEMU has ended with 1:\nno bootable device" in str(refused.value)
    assert f"remove {one.folder} as its owner or as root" in str(refused.value)


def test_a_computer_that_does_not_go_on_names_what_was_kept(tmp_path: Path) -> None:
    machine = ended(tmp_path)
    machine.kept = tmp_path / "booted-1"
    with pytest.raises(places.CannotBench, match=r"has ended with 1:\n(.|\n)*remove \S+/booted-1 as its owner"):
        machine.go_on()


def test_a_line_to_the_agent_that_is_reset_is_told_as_the_end_of_qemu(tmp_path: Path) -> None:
    """What it has not read of a line when it ends resets the line."""
    ours, its = socket.socketpair()
    machine = ended(tmp_path)
    machine._agent = ours
    ours.send(b"unread")
    its.close()
    with pytest.raises(places.CannotBench, match="QEMU has ended with 1"):
        machine.check()
    machine.process = SimpleNamespace(poll=lambda: None, wait=lambda seconds: _ends(machine))  # type: ignore[assignment]
    with pytest.raises(places.CannotBench, match="QEMU has ended with 9:\nno bootable device"):
        machine._line(time.monotonic() + 5.0)
    ours.close()


def _ends(machine: Machine) -> None:
    """It ends while it is waited for."""
    machine.process = SimpleNamespace(poll=lambda: 9, returncode=9)  # type: ignore[assignment]
