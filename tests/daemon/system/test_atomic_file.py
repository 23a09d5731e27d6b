"""Files that are written whole, by root too, into a folder of another user."""

import os
from pathlib import Path

import pytest

from daemon.system.atomic_file import write_whole

ROOT_ALONE = pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
OTHER = 65_534


def test_a_link_in_the_place_of_the_temporary_file_is_not_followed(tmp_path: Path) -> None:
    """The owner of the folder could otherwise have root write to any file."""
    target = tmp_path / "shadow"
    target.write_bytes(b"mine")
    (tmp_path / ".a.lumimap.part").symlink_to(target)
    write_whole(tmp_path / "a.lumimap", b"map")
    assert target.read_bytes() == b"mine"
    assert (tmp_path / "a.lumimap").read_bytes() == b"map"
    assert not (tmp_path / "a.lumimap").is_symlink()


def test_what_a_killed_process_has_left_is_replaced(tmp_path: Path) -> None:
    (tmp_path / ".a.part").write_bytes(b"a long half of a file")
    write_whole(tmp_path / "a", b"whole")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a", b"whole")]


@ROOT_ALONE
def test_a_file_of_root_belongs_to_the_owner_of_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    os.chown(folder, OTHER, OTHER)
    mask = os.umask(0o077)
    try:
        write_whole(folder / "a", b"map")
        write_whole(tmp_path / "b", b"map")
    finally:
        os.umask(mask)
    about = (folder / "a").stat()
    assert (about.st_uid, about.st_gid, about.st_mode & 0o777) == (OTHER, OTHER, 0o600)
    assert (tmp_path / "b").stat().st_uid == tmp_path.stat().st_uid
