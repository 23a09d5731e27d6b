"""What the driver says to a sensor, and what it never says to whom."""

from __future__ import annotations

import asyncio
import logging

import pytest

from hal.errors import DeviceFault
from hal.fake.lidar.models import MODELS, UST_10LX
from tests.hal.hokuyo.bench import PORT, Bench, error_of, on_fake


def heard(bench: Bench) -> list[str]:
    """Everything said to the fake, as two-letter words with the digit of TM."""
    assert bench.fake is not None
    words: list[str] = []
    receive = bench.fake.receive

    def listen(data: bytes) -> None:
        words.extend(line.decode() for line in data.split(b"\n") if line)
        receive(data)

    bench.fake.receive = listen  # type: ignore[method-assign]  # a tap
    return words


class TestWords:
    @pytest.mark.parametrize("name", ["URG-04LX", "URG-04LX-UG01", "UBG-04LX-F01", "UHG-08LX"])
    @pytest.mark.parametrize(
        "faults",
        [
            "",
            '[[fault]]\nwhat = "intermittent"\nshare = 1.0\nfor = 40.0\nwhen = 3.0',
            '[[fault]]\nwhat = "silence"\nfor = 40.0\nwhen = 3.0',
            '[[fault]]\nwhat = "garbage"\non = "all"\nfor = 40.0\nwhen = 3.0',
            '[[fault]]\nwhat = "status"\ncode = 60\nfor = 20.0\nwhen = 3.0',
            '[[fault]]\nwhat = "no_reply"\ncommand = "VV"\nfor = 20.0',
        ],
        ids=["fine", "no scans", "mute", "garbage", "hardware fault", "VV lost"],
    )
    def test_old_firmware_hears_only_what_it_can_digest(self, name: str, faults: str) -> None:
        """Anything else has been seen to wedge it until a power cycle."""
        model = MODELS[name]

        async def body(bench: Bench) -> None:
            words = heard(bench)
            if faults:
                bench.order(faults)
            driver = bench.driver(intensity=True)
            async with bench.running(driver):
                await asyncio.sleep(60.0)
                await bench.more(5, 20.0, driver)
            assert driver.status.extra["intensity"] == "off: the model has none"
            said = {word[:2] for word in words}
            assert said <= {"VV", "PP", "II", "QT", "RS", "BM", "TM", "SS", "SC", "MD", "MS", "GD", "GS"}
            assert "MD" in said

        rs232 = model.link == "rs232"
        on_fake(body, model, device="/dev/ttyUSB7" if rs232 else PORT)

    def test_ladder_of_a_sensor_that_never_delivers(self) -> None:
        """QT, then a reset, then a new connection, then reboots at growing distances, for ever."""

        async def body(bench: Bench) -> None:
            assert bench.plugs is not None
            words = heard(bench)
            bench.order('[[fault]]\nwhat = "intermittent"\nshare = 1.0')
            driver = bench.driver()
            async with bench.running(driver):
                await asyncio.sleep(1500.0)
                first = {word: words.index(word) for word in ("QT", "VV", "RT", "RB")}
                assert first["QT"] < first["VV"] < first["RT"] < first["RB"]
                assert words[first["RB"] + 1] == "RB"  # a pair within a second
                streams = [i for i, word in enumerate(words) if word.startswith("MD")]
                assert sum(i < first["RT"] for i in streams) == 2
                assert bench.plugs.opened > 5
                assert words.count("RB") == 8
                assert len(words) < 2500  # it does not spin
                assert isinstance(error_of(driver), DeviceFault)
                assert bench.faults is not None
                bench.faults.clear()
                await bench.more(20, 20.0, driver)
                assert driver.status.error is None

        on_fake(body, UST_10LX)

    def test_only_a_valid_scan_sets_the_ladder_back(self) -> None:
        """Opening well, and even frames that are damaged, must not look like success."""

        async def body(bench: Bench) -> None:
            words = heard(bench)
            bench.order('[[fault]]\nwhat = "bit_flip"\npart = "data"')
            async with bench.running(bench.driver()):
                await asyncio.sleep(120.0)
            assert bench.scans == []
            assert "RT" in words
            assert "RB" in words

        on_fake(body, UST_10LX)

    def test_a_sensor_that_sends_one_scan_and_hangs_is_reset_and_told_of_once(
        self, caplog: pytest.LogCaptureFixture
    ) -> None:
        async def body(bench: Bench) -> None:
            words = heard(bench)
            async with bench.running(bench.driver()):
                bench.order('[[fault]]\nwhat = "stuck"')
                await asyncio.sleep(120.0)
                assert len(bench.scans) > 5  # the first of every stream looks good
                assert words.index("RT") < words.index("RB")
                assert len(words) < 600
                assert len(caplog.records) < 4
                assert bench.faults is not None
                bench.faults.clear()
                await asyncio.sleep(60.0)
                assert "delivers again" in caplog.records[-1].message

        with caplog.at_level(logging.INFO, "hal"):
            on_fake(body, UST_10LX)

    def test_a_loose_contact_does_not_fill_the_log(self, caplog: pytest.LogCaptureFixture) -> None:
        async def body(bench: Bench) -> None:
            driver = bench.driver()
            async with bench.running(driver):
                for _ in range(40):
                    await asyncio.sleep(5.0)
                    bench.order('[[fault]]\nwhat = "hangup"\nfor = 0.3')
                await asyncio.sleep(5.0)
                assert driver.status.reconnects == 40
                assert len(caplog.records) <= 4
                await asyncio.sleep(60.0)
                before = len(caplog.records)
                bench.order('[[fault]]\nwhat = "hangup"\nfor = 0.3')
                await asyncio.sleep(5.0)
                assert len(caplog.records) > before

        with caplog.at_level(logging.INFO, "hal"):
            on_fake(body)

    def test_error_state_is_answered_with_a_reboot(self) -> None:
        async def body(bench: Bench) -> None:
            words = heard(bench)
            driver = bench.driver()
            async with bench.running(driver):
                await bench.more(20, 6.0, driver)
                bench.order('[[fault]]\nwhat = "error"')
                await asyncio.sleep(0.02)
                await bench.more(20, 12.0, driver)
            assert words.count("RB") == 2

        on_fake(body, UST_10LX)

    def test_self_check_is_waited_for(self) -> None:
        """21, seconds of nothing, 98: the sensor verifies a doubt; resetting it then would start all over."""

        async def body(bench: Bench) -> None:
            words = heard(bench)
            driver = bench.driver()
            async with bench.running(driver):
                await bench.more(20, 6.0, driver)
                before = len(words)
                bench.order('[[fault]]\nwhat = "verify"\nfor = 5.0')
                await asyncio.sleep(2.0)
                assert "21" in str(error_of(driver))
                await bench.more(20, 5.0, driver)
                assert len(words) == before

        on_fake(body)
