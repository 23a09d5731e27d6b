"""Which software a recording was made with, where that is not what runs."""

from pathlib import Path

import pytest

from daemon.system import versions

HERE = versions.versions()


def test_what_was_made_here_needs_no_word() -> None:
    assert versions.made_elsewhere({"versions": HERE}) == ""
    assert versions.made_elsewhere({"versions": {**HERE, "commit": "0" * 12}}) == ""  # of the same sources
    assert versions.made_elsewhere({"versions": {"lumiloop": HERE["lumiloop"]}}) == ""  # an older one says no more
    assert versions.made_elsewhere({}) == ""
    assert versions.made_elsewhere({"versions": "of last year"}) == ""


def test_another_build_is_named_with_all_that_differs_and_nothing_else() -> None:
    told = {**HERE, "lumiloop": "0.0.7", "build": "of last year", "numpy": "1.0"}
    said = versions.made_elsewhere({"versions": told})
    here = f"lumiloop {HERE['lumiloop']}, build {HERE['build']}, numpy {HERE['numpy']}"
    theirs = "lumiloop 0.0.7, build of last year, numpy 1.0"
    assert said == f"recorded with {theirs}; this is {here}, so the replay may differ from the recorded run"


def test_what_a_recording_says_of_itself_gives_a_terminal_no_orders() -> None:
    said = versions.made_elsewhere({"versions": {"lumiloop": "\x1b[2J" + 100 * "x", "build": None}})
    assert "\x1b" not in said
    assert 41 * "x" not in said


def test_the_build_is_that_of_the_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(versions, "ROOT", tmp_path)
    (tmp_path / "hal").mkdir()
    found = set()
    for text in ("a = 1\n", "a = 2\n", "a = 1\n"):
        (tmp_path / "hal" / "one.py").write_text(text)
        versions.build.cache_clear()
        found.add(versions.build())
    versions.build.cache_clear()
    assert len(found) == 2


def test_the_commit_is_that_of_a_tree_or_of_a_worktree(tmp_path: Path) -> None:
    assert versions._commit(tmp_path) == ""
    git = tmp_path / "main" / ".git"
    (git / "refs" / "heads").mkdir(parents=True)
    (git / "HEAD").write_text("ref: refs/heads/main\n")
    assert versions._commit(tmp_path / "main") == ""
    (git / "packed-refs").write_text(f"# pack-refs\n{40 * 'a'} refs/heads/main\n{40 * 'b'} refs/heads/other\n")
    assert versions._commit(tmp_path / "main") == 12 * "a"
    (git / "refs" / "heads" / "other").write_text(40 * "c" + "\n")
    there = git / "worktrees" / "there"
    there.mkdir(parents=True)
    (there / "HEAD").write_text("ref: refs/heads/other\n")
    (there / "commondir").write_text("../..\n")
    tree = tmp_path / "there"
    tree.mkdir()
    (tree / ".git").write_text(f"gitdir: {there}\n")
    assert versions._commit(tree) == 12 * "c"
    (there / "HEAD").write_text(40 * "d" + "\n")
    assert versions._commit(tree) == 12 * "d"
