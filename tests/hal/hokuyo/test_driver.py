"""The driver's conduct: finding the right sensor, waiting, telling people, stopping."""

import asyncio
import logging

import numpy as np
import pytest

from hal.errors import DeviceMissing, DeviceRefused
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.models import UTM_30LX, Unit
from hal.hokuyo import discover
from hal.lidar import Link
from hal.port.port import Port
from tests.hal.hokuyo.bench import PORT, Bench, Scene, error_of, faked, on_fake


class TestFindingTheSensor:
    @faked()
    async def test_auto_takes_the_first_that_is_a_lidar(self, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
        assert bench.plugs is not None
        mute = FakeHokuyo(UTM_30LX, Scene(UTM_30LX))
        mute.receive = lambda data: None  # type: ignore[method-assign]  # something that is no lidar
        bench.plugs.plug("/dev/ttyUSB3", mute)
        monkeypatch.setattr(discover, "candidates", lambda: ["/dev/ttyUSB3", "/dev/ttyACM5", PORT])
        bench.device = "auto"
        driver = bench.driver()
        await bench.deliver(driver, 5, within=12.0)
        assert driver.status.extra["device"] == PORT

    @faked(unit=Unit(serial="H0000001"))
    async def test_a_sensor_is_known_by_its_serial_wherever_it_is_plugged_in(
        self, bench: Bench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        assert bench.plugs is not None
        assert bench.fake is not None
        other = FakeHokuyo(UTM_30LX, Scene(UTM_30LX), unit=Unit(serial="H0000002"))
        bench.plugs.plug("/dev/ttyACM0", other)
        monkeypatch.setattr(discover, "candidates", lambda: [f"/dev/ttyACM{i}" for i in range(9)])
        bench.device = "auto"
        driver = bench.driver(serial="H0000001")
        async with bench.running(driver):
            await bench.more(40, 8.0, driver)
            assert driver.status.extra["device"] == PORT
            bench.plugs.unplug(PORT)
            await asyncio.sleep(3.0)
            assert isinstance(error_of(driver), (DeviceMissing, DeviceRefused))
            assert "H0000001" in str(error_of(driver))
            bench.plugs.plug("/dev/ttyACM3", bench.fake)
            await bench.more(40, 7.0, driver)
            assert driver.status.extra["device"] == "/dev/ttyACM3"
            assert driver.status.reconnects == 1
        assert other.state is State.IDLE

    @faked()
    async def test_auto_with_nothing_there(self, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(discover, "candidates", list)
        bench.device = "auto"
        driver = bench.driver(serial="H7")
        async with bench.running(driver):
            await asyncio.sleep(1.0)
            assert str(error_of(driver)).startswith("auto: no HOKUYO H7 was found (connect the sensor")

    @faked(unit=Unit(serial="H0000001"))
    async def test_another_sensor_at_the_named_port_is_refused(self, bench: Bench) -> None:
        driver = bench.driver(serial="H0000009")
        async with bench.running(driver):
            await asyncio.sleep(3.0)
            error = error_of(driver)
            assert isinstance(error, DeviceRefused)
            assert "is sensor H0000001, not H0000009" in str(error)
            assert bench.scans == []

    @faked()
    async def test_impossible_rate(self, bench: Bench) -> None:
        with pytest.raises(ValueError, match="line rate 9600: SCIP has 19200"):
            bench.driver(baud=9600)


class TestWaiting:
    def test_missing_then_there(self, caplog: pytest.LogCaptureFixture) -> None:
        async def body(bench: Bench) -> None:
            assert bench.plugs is not None
            assert bench.fake is not None
            bench.plugs.unplug(PORT)
            driver = bench.driver()
            async with bench.running(driver):
                await asyncio.sleep(60.0)
                assert driver.status.link in (Link.WAITING, Link.OPENING)
                assert isinstance(error_of(driver), DeviceMissing)
                assert error_of(driver).device == PORT
                assert len(caplog.records) == 1  # once, not at every attempt
                bench.plugs.plug(PORT, bench.fake)
                await bench.more(40, 8.0, driver)
                assert [record.levelname for record in caplog.records] == ["INFO", "INFO"]
                assert "no such device (plugged in: nothing)" in caplog.text
                assert "UTM-30LX" in caplog.records[1].message
                bench.plugs.unplug(PORT)
                await asyncio.sleep(0.5)
                bench.plugs.plug(PORT, bench.fake)
                before = bench.clock.now()
                await bench.more(1, 2.0, driver)
                assert bench.clock.now() - before < 2.0
                await bench.more(20, 2.0, driver)
                assert caplog.records[2].message.startswith("lidar lost: ")
                assert "delivers again" in caplog.records[-1].message

        with caplog.at_level(logging.INFO, "hal"):
            on_fake(body)

    @pytest.mark.parametrize(
        "error",
        [
            DeviceRefused(PORT, "permission denied", "add the user to group dialout and log in again"),
            DeviceRefused(PORT, "in use by another program", f"find it with: fuser -v {PORT}"),
            DeviceRefused(PORT, "not a serial port", "name the device file of the sensor, such as"),
            DeviceMissing(PORT, "no such device", "connect the sensor"),
        ],
        ids=str,
    )
    @faked()
    async def test_what_the_port_says_reaches_the_status(
        self, bench: Bench, error: DeviceMissing | DeviceRefused
    ) -> None:
        good, refuse = bench.opener, True

        async def opener(device: str, baud: int) -> Port:
            if refuse:
                raise error
            return await good(device, baud)

        bench.opener = opener
        driver = bench.driver()
        async with bench.running(driver):
            await asyncio.sleep(30.0)
            assert driver.status.error is error
            refuse = False
            await bench.more(5, 7.0, driver)

    @faked()
    async def test_waits_grow_to_four_seconds_and_it_never_gives_up(self, bench: Bench) -> None:
        attempts: list[float] = []

        async def opener(device: str, baud: int) -> Port:
            attempts.append(bench.clock.now())
            raise DeviceMissing(device, "no such device")

        bench.opener = opener
        async with bench.running(bench.driver()):
            await asyncio.sleep(86_400.0)
        gaps = np.diff(attempts)
        assert 0.15 < gaps[0] < 0.21
        assert gaps[:10].max() > 3.1
        assert gaps.max() <= 4.0
        assert len(set(np.round(gaps[10:], 3))) > 100  # jitter
        assert 86_400 - (attempts[-1] - attempts[0]) < 5.0


class TestStopping:
    @pytest.mark.parametrize("after", [0.0, 0.0003, 0.001, 0.004, 0.02, 0.05, 0.1, 0.5, 2.0])
    @faked()
    async def test_laser_off_within_a_tenth_of_a_second(self, bench: Bench, after: float) -> None:
        assert bench.fake is not None
        assert bench.plugs is not None
        driver = bench.driver()
        async with bench.running(driver):
            await asyncio.sleep(after)
            began = bench.clock.now()
        assert bench.clock.now() - began <= 0.1001
        await asyncio.sleep(0.05)
        assert bench.fake.state is State.IDLE
        assert driver.status.link is Link.CLOSED
        if after:
            (await bench.opener(PORT, 0)).close()  # the port was given back

    @faked()
    async def test_a_sensor_that_ignores_qt_does_not_hold_us_up(self, bench: Bench) -> None:
        async with bench.running(bench.driver()):
            await asyncio.sleep(3.0)
            assert bench.scans
            bench.order('[[fault]]\nwhat = "ignore"\ncommand = "QT"')
            await asyncio.sleep(0.01)
            began = bench.clock.now()
        assert 0.09 < bench.clock.now() - began < 0.11

    @pytest.mark.parametrize("fault", ["silence", "stuck"])
    @faked()
    async def test_during_every_wait_of_a_recovery(self, bench: Bench, fault: str) -> None:
        bench.order(f'[[fault]]\nwhat = "{fault}"')
        for after in np.arange(0.05, 12.0, 0.37):
            async with bench.running(bench.driver()):
                await asyncio.sleep(float(after))
                began = bench.clock.now()
            assert bench.clock.now() - began <= 0.1001
            await asyncio.sleep(0.01)
            (await bench.opener(PORT, 0)).close()  # the port was given back
            await asyncio.sleep(0.01)
