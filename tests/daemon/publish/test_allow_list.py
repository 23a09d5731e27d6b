"""Who is answered: the list, this computer, and a log that a crowd does not fill."""

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


@pytest.mark.parametrize("listed", ["192.168.0.0/24", "::ffff:192.168.0.0/120", "::FFFF:c0a8:0/120"])
def test_an_ipv4_network_and_its_mapped_form_are_the_same(listed: str) -> None:
    access = Access((listed,))
    for host in ("192.168.0.1", "::ffff:192.168.0.1", "::ffff:c0a8:ff", "::ffff:127.0.0.1"):
        assert access(host), host
    for host in ("192.168.1.1", "::ffff:192.168.1.1", "::c0a8:1", "fe80::1"):
        assert not access(host), host


def test_mapped_single_addresses_and_the_whole_of_ipv4() -> None:
    assert Access(("::ffff:10.0.0.7",))("10.0.0.7")
    assert not Access(("::ffff:10.0.0.7",))("10.0.0.8")
    assert Access(("::ffff:0:0/96",))("203.0.113.9")
    assert not Access(("::ffff:0:0/96",))("2001:db8::1")
    assert Access(("fd00::/8",), "::ffff:10.0.0.1")("10.0.0.1")


def test_a_mapped_network_with_host_bits_is_refused_with_the_network_meant() -> None:
    with pytest.raises(ValueError, match=r"Expected `192\.168\.0\.0/24` \(the network\)"):
        Access(("::ffff:192.168.0.7/120",))


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
