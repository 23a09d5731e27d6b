"""Who answers at a port, told from a made-up /proc."""

from pathlib import Path

import pytest

from daemon.publish import port_owner
from daemon.publish.port_owner import Whose

PORT = 1502
LOOPBACK, ANY = "0100007F", "00000000"
ANY6 = 32 * "0"
MEANT, OTHER = 77, 55


class Computer:
    """Its processes and sockets; that of the configured name is ``MEANT``."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.tables: dict[str, list[str]] = {"udp": ["head"], "udp6": ["head"]}
        self.process(MEANT)

    def socket(self, address: str, inode: int) -> None:
        table = "udp" if len(address) == 8 else "udp6"
        peer = len(address) * "0"
        self.tables[table].append(f"1: {address}:{PORT:04X} {peer}:0000 07 0:0 0:0 0 1000 0 {inode} 2 0 0")
        (self.root / "net").mkdir(exist_ok=True)
        (self.root / "net" / table).write_text("\n".join(self.tables[table]))

    def process(self, pid: int, *inodes: int, command: bytes = b"python\0robot.py\0", network: int = 1) -> None:
        (self.root / str(pid) / "fd").mkdir(parents=True)
        (self.root / str(pid) / "ns").mkdir()
        (self.root / str(pid) / "ns" / "net").symlink_to(f"net:[{network}]")
        (self.root / str(pid) / "cmdline").write_bytes(command)
        for at, inode in enumerate(inodes):
            (self.root / str(pid) / "fd" / str(at)).symlink_to(f"socket:[{inode}]")

    def whose(self, host: str = "127.0.0.1") -> Whose:
        return port_owner.whose("agv", host, PORT)


@pytest.fixture
def computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Computer:
    monkeypatch.setattr(port_owner, "PROC", tmp_path)
    monkeypatch.setattr(port_owner, "_listener", lambda path: MEANT)
    (tmp_path / "self" / "ns").mkdir(parents=True)
    (tmp_path / "self" / "ns" / "net").symlink_to("net:[1]")
    return Computer(tmp_path)


@pytest.mark.parametrize("address", [LOOPBACK, ANY, ANY6])
def test_another_daemon_that_has_the_port_is_another(computer: Computer, address: str) -> None:
    computer.socket(address, 9)
    computer.process(OTHER, 9)
    found = computer.whose()
    assert (found.pid, found.another) == (OTHER, True)
    assert str(found) == f"process {OTHER}: python robot.py"


def test_what_is_bound_to_every_address_does_not_answer_where_something_nearer_is_bound(computer: Computer) -> None:
    """The daemon's own sockets cannot be looked into: it is another user's."""
    computer.socket(LOOPBACK, 8)
    computer.socket(ANY, 9)
    computer.socket(ANY6, 10)
    computer.process(OTHER, 9, 10)
    assert computer.whose() == Whose(0, "", MEANT)
    assert not computer.whose().another
    assert computer.whose("::1").another


def test_who_is_seen_at_one_of_several_sockets_may_not_be_who_answers(computer: Computer) -> None:
    computer.socket(LOOPBACK, 8)
    computer.socket(LOOPBACK, 9)
    computer.process(OTHER, 9)
    assert computer.whose() == Whose(0, "", MEANT)
    computer.process(OTHER + 1, 8)
    assert computer.whose().another


def test_a_container_s_daemon_answers_at_the_port_that_is_published_for_it(tmp_path: Path, computer: Computer) -> None:
    """A process outside passes the datagrams on, and holds the port."""
    computer.socket(ANY, 9)
    computer.process(OTHER, 9, command=b"/usr/bin/docker-proxy\0-proto\0udp\0")
    (tmp_path / str(MEANT) / "ns" / "net").unlink()
    (tmp_path / str(MEANT) / "ns" / "net").symlink_to("net:[2]")
    found = computer.whose()
    assert not found.another
    assert str(found) == (
        f"process {OTHER}: /usr/bin/docker-proxy -proto udp (the configured name belongs to process {MEANT} in "
        "another network namespace)"
    )


def test_a_command_line_is_shown_as_one_line_of_letters(computer: Computer) -> None:
    computer.socket(LOOPBACK, 9)
    computer.process(OTHER, 9, command="a\x1b[2J\nstate  TRACKING\0é\u202e".encode() + b"\xff")
    assert computer.whose().command == r"a\x1b[2J\nstate  TRACKING é\u202e" + "\ufffd"
