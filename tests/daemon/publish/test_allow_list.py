"""Who is answered: the list, this computer, and a log that a crowd does not fill."""

from __future__ import annotations

import logging

import pytest

from daemon.publish.allow_list import TOLD, Access


def test_an_empty_list_answers_everyone() -> None:
    access = Access((), "0.0.0.0")
    assert access("203.0.113.9")
    assert access("fe80::1%eth0")
    assert access.refused == 0


def test_a_list_answers_its_networks_and_this_computer() -> None:
    access = Access(("192.168.0.0/24", "10.0.0.7", "fd00::/8"), "192.168.5.5")
    for host in ("192.168.0.200", "10.0.0.7", "fd12::1%eth0", "127.0.0.1", "127.8.0.1", "::1", "192.168.5.5"):
        assert access(host), host
    for host in ("192.168.1.1", "10.0.0.8", "2001:db8::1", "no address"):
        assert not access(host), host
        assert not access(host), host
    assert access.refused == 8


def test_a_bind_to_all_allows_nobody_more() -> None:
    for every in ("0.0.0.0", "::"):
        assert not Access(("10.0.0.0/8",), every)("203.0.113.9")


def test_a_crowd_is_told_of_once_each_and_not_for_ever(caplog: pytest.LogCaptureFixture) -> None:
    access = Access(("10.0.0.0/8",))
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            for number in range(200):
                assert not access(f"203.0.113.{number}")
    assert len(caplog.records) == TOLD
    assert access.refused == 400
