"""A computer that is booted once for its image: what is kept of it, how a run goes on, and QEMU's command line."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import threading
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from tools.bench.vm import booted, image, places, whole
from tools.bench.vm import machine as machines
from tools.bench.vm.machine import Machine, Order, Ports, command_line


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
    try:
        with pytest.raises(places.CannotBench, match="QEMU has ended"):
            third._until_status("paused", "taking what is no memory")
    finally:
        third.stop()


@pytest.mark.parametrize("hears", [0, 1, 2, 3])
@pytest.mark.parametrize("cut", ["closed", "reset"])
def test_a_qemu_that_ends_while_it_is_asked_is_told_from_one_that_does_not_take_it(
    hears: int, cut: str, tmp_path: Path
) -> None:
    """At each word of the talk: before its greeting, after it, and after the first and the second order."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "qmp"))
    listener.listen()
    (tmp_path / "qemu").write_text("load of migration failed")
    process = subprocess.Popen(["sleep", "60"])

    def talks() -> None:
        link = listener.accept()[0]
        for word in (b'{"QMP": {}}\n', b'{"return": {}}\n', b'{"return": {"status": "inmigrate"}}\n')[:hears]:
            link.sendall(word)
            link.recv(4096, socket.MSG_PEEK if cut == "reset" else 0)  # what is not read resets the line
        link.close()
        process.kill()

    talking = threading.Thread(target=talks)
    talking.start()
    machine = Machine(process, tmp_path, Ports(1, 2, 3), threading.Event())
    with pytest.raises(places.CannotBench, match="QEMU has ended with -9:\nload of migration failed"):
        machine._until_status("paused", "taking what is no memory")
    talking.join()
    machine.stop()
    listener.close()


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
    for name in ("disk", "memory"):
        (tmp_path / f"booted-{key}" / name).write_bytes(b"x")
    kept = booted.Booted(made, tmp_path / f"booted-{key}")
    whole.note(kept.folder, kept.parts)
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


def stood_in_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A first boot that takes no time."""

    def boots(folder: Path, made: booted.Booted) -> float:
        made.disk.write_bytes(b"x")
        made.memory.write_bytes(b"x")
        return 31.5

    monkeypatch.setattr(booted, "QEMU", "echo")
    monkeypatch.setattr(booted, "_boot", boots)


def test_what_was_kept_is_not_gone_on_from_where_it_is_not_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stood_in_for(monkeypatch)
    said: list[str] = []
    assert booted.booted(image.Image(tmp_path), said.append).seconds == 31.5
    assert booted.booted(image.Image(tmp_path), said.append).lacks() == ""
    assert len(said) == 2
    (kept,) = tmp_path.iterdir()
    (kept / "memory").write_bytes(b"")
    (kept / "told.json").unlink()
    assert booted.booted(image.Image(tmp_path), said.append).lacks() == ""
    assert f"{kept} was not whole (no memory, no told.json)" in said[2]


@pytest.mark.parametrize("stage", ["wait_until_up", "run"])
def test_an_agent_that_fails_in_the_first_boot_is_said_as_any_other_reason(
    stage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut(*given: object, **named: object) -> None:
        raise Order("the line to the agent inside has been cut")

    machine = SimpleNamespace(wait_until_up=lambda: 1.0, run=lambda *words, **named: "running")
    setattr(machine, stage, cut)
    monkeypatch.setattr(booted.subprocess, "run", lambda *words, **named: SimpleNamespace(returncode=0))
    monkeypatch.setattr(booted, "started", lambda *given: nullcontext(machine))
    with pytest.raises(places.CannotBench, match="not come up well: the line to the agent inside has been cut"):
        booted._boot(tmp_path, booted.Booted(image.Image(tmp_path), tmp_path))


def test_a_qemu_that_says_nothing_any_more_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machines, "DEAF_S", 0.2)
    monkeypatch.setattr(machines, "QUIT_S", 0.2)
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "qmp"))
    listener.listen()
    machine = Machine(subprocess.Popen(["sleep", "60"]), tmp_path, Ports(1, 2, 3), threading.Event())
    with pytest.raises(places.CannotBench, match="QEMU does not take cont: timed out"):
        machine._monitor("cont")
    machine.stop()
    listener.close()


def test_a_first_boot_takes_the_place_of_a_killed_one_of_its_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stood_in_for(monkeypatch)
    left = tmp_path / f"part-{os.getpid()}"
    left.mkdir()
    (left / "rest").touch()
    made = booted.booted(image.Image(tmp_path), lambda text: None)
    assert made.seconds == 31.5
    assert not (made.folder / "rest").exists()
