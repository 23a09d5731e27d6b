"""Data of the driver: ranges, intensities, stamps, and the words that are no distance."""

import asyncio
import logging
from collections.abc import Callable
from dataclasses import replace

import pytest

from hal.errors import DeviceFault
from hal.fake.lidar.models import ECHOES, MODELS, PLAIN, UST_10LX, UTM_30LX, LidarModel, Unit
from hal.hokuyo.driver import HokuyoDriver
from hal.hokuyo.passive import PassiveHokuyo
from hal.port.port import OnData, OnLost, Port
from tests.hal.hokuyo.bench import PORT, Bench, error_of, faked, on_fake


class TestIntensity:
    def run(self, model: LidarModel, check: Callable[[Bench, HokuyoDriver], None], fault: str = "") -> None:
        async def body(bench: Bench) -> None:
            if fault:
                bench.order(fault)
            driver = bench.driver(intensity=True)
            await bench.deliver(driver, 30, within=20.0)
            check(bench, driver)

        on_fake(body, model)

    def test_proved_and_used(self) -> None:
        def check(bench: Bench, driver: HokuyoDriver) -> None:
            assert driver.status.extra["intensity"] == "on"
            assert driver.status.dialect == "SCIP 2.2 ME"
            for scan in bench.scans:
                assert scan.intensity is not None
                assert (scan.intensity[3:9] == scan.ranges[3:9] // 2).all()

        self.run(UST_10LX, check)

    def test_a_usb_utm_is_not_asked_for_more_than_it_can_bear(self) -> None:
        """95 degrees times the cluster: all 270 degrees at three steps together."""

        def check(bench: Bench, driver: HokuyoDriver) -> None:
            assert driver.status.dialect == "SCIP 2.0 ME, 3 steps together"
            assert {len(scan.ranges) for scan in bench.scans} <= {360, 361}
            assert bench.scans[0].stride == 3

        self.run(UTM_30LX, check)

    def test_refused(self) -> None:
        def check(bench: Bench, driver: HokuyoDriver) -> None:
            assert driver.status.extra["intensity"] == "off: ME answers 0E"
            assert driver.status.dialect == "SCIP 2.2 MD"
            assert bench.scans[0].intensity is None

        self.run(replace(UST_10LX, measures=PLAIN), check)

    def test_all_dark(self) -> None:
        def check(bench: Bench, driver: HokuyoDriver) -> None:
            assert driver.status.extra["intensity"] == "off: every intensity is 0"
            assert driver.status.dialect == "SCIP 2.2 MD"

        self.run(UST_10LX, check, '[[fault]]\nwhat = "dark"\nfor = 2.0')

    def test_never_arrives(self) -> None:
        def check(bench: Bench, driver: HokuyoDriver) -> None:
            assert driver.status.extra["intensity"] == "off: no scan within 6 s"

        self.run(UST_10LX, check, '[[fault]]\nwhat = "intermittent"\nshare = 1.0\ncount = 1')

    def test_damaged(self) -> None:
        def check(bench: Bench, driver: HokuyoDriver) -> None:
            assert driver.status.extra["intensity"].startswith("off: checksum")

        self.run(UST_10LX, check, '[[fault]]\nwhat = "bit_flip"\nbit = 0\ncount = 1')

    @faked(UST_10LX)
    async def test_a_stream_that_dies_of_it_is_given_up(self, bench: Bench) -> None:
        """One scan with intensities came, the stream brings the sensor down every time: distances alone will do."""
        assert bench.fake is not None
        assert bench.faults is not None
        receive, faults = bench.fake.receive, bench.faults

        def weak(data: bytes) -> None:
            faults.clear()
            if data.strip().startswith(b"ME") and data.strip().endswith(b"00"):
                bench.order('[[fault]]\nwhat = "intermittent"\nshare = 1.0')
            receive(data)

        bench.fake.receive = weak  # type: ignore[method-assign]  # a weak sensor
        driver = bench.driver(intensity=True)
        await bench.deliver(driver, 30, within=40.0)
        assert driver.status.extra["intensity"] == "off: stopped after failures"
        assert driver.status.dialect == "SCIP 2.2 MD"

    @faked(replace(UST_10LX, measures=ECHOES), Unit(spin_up_s=2.0))
    async def test_lost_port_while_proving(self, bench: Bench) -> None:
        driver = bench.driver(intensity=True)
        bench.order('[[fault]]\nwhat = "hangup"\nwhen = 0.05\nfor = 1.0')
        await bench.deliver(driver, 30, within=20.0)
        assert driver.status.extra["intensity"] == "on"


@faked(UST_10LX)
async def test_no_return_of_a_ust_is_no_range_even_where_dmax_allows_it(bench: Bench) -> None:
    bench.order('[[fault]]\nwhat = "dmax"\n[[fault]]\nwhat = "codes"\nvalue = 65533\nbeams = 1.0')
    scans = await bench.deliver(bench.driver(), 10, within=8.0)
    assert scans[0].geometry.dmax == 262143
    assert (scans[0].code == 65533).all()
    assert not scans[0].ranges.any()


@pytest.mark.parametrize("intensity", [False, True])
@faked(UST_10LX)
async def test_what_was_received_gives_the_same_scans_again(bench: Bench, intensity: bool) -> None:
    """A recording of the bytes and their times, heard by the passive listener: the same scans to the last bit."""
    log: list[tuple[bytes, float] | None] = []
    real = bench.opener

    async def opener(device: str, baud: int) -> Port:
        port = await real(device, baud)
        start = port.start

        def tapped(on_data: OnData, on_lost: OnLost) -> None:
            log.append(None)
            start(lambda data, t: (log.append((data, t)), on_data(data, t))[0], on_lost)

        port.start = tapped  # type: ignore[method-assign]  # a tap
        return port

    bench.opener = opener
    driver = bench.driver(intensity=intensity)
    async with bench.running(driver):
        await bench.more(300, 20.0, driver)
        bench.order('[[fault]]\nwhat = "bit_flip"\ncount = 5')
        await bench.more(100, 5.0, driver)
        bench.order('[[fault]]\nwhat = "set_clock"\nms = 77')
        await bench.more(100, 5.0, driver)
        bench.order('[[fault]]\nwhat = "hangup"\nfor = 0.5')
        await bench.more(100, 10.0, driver)
    listener = PassiveHokuyo(device=PORT)
    heard = []
    for entry in log:
        if entry is None:
            listener.restart()
        else:
            heard += listener.feed(*entry)
    by_arrival = {scan.t_rx: scan for scan in heard}
    assert len(bench.scans) >= 600
    for scan in bench.scans:
        twin = by_arrival[scan.t_rx]
        assert (twin.t_mono, twin.t_sigma, twin.t_tick) == (scan.t_mono, scan.t_sigma, scan.t_tick)
        assert (twin.ranges == scan.ranges).all()
        assert (twin.code == scan.code).all()
        assert twin.geometry == scan.geometry
    if not intensity:
        assert len(heard) - len(bench.scans) <= 1  # the frame under way when the driver left


@faked()
async def test_sensors_text_is_kept_for_people(bench: Bench) -> None:
    bench.order('[[fault]]\nwhat = "trouble"')
    driver = bench.driver()
    await bench.deliver(driver, 10, within=8.0)
    assert driver.status.extra["state"] == "Trouble!! Error No. =[00->33]"
    assert driver.status.extra["serial"] == "H0706400"


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

    @faked(UST_10LX)
    async def test_ladder_of_a_sensor_that_never_delivers(self, bench: Bench) -> None:
        """QT, then a reset, then a new connection, then reboots at growing distances, for ever."""
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

    @faked(UST_10LX)
    async def test_only_a_valid_scan_sets_the_ladder_back(self, bench: Bench) -> None:
        """Opening well, and even frames that are damaged, must not look like success."""
        words = heard(bench)
        bench.order('[[fault]]\nwhat = "bit_flip"\npart = "data"')
        async with bench.running(bench.driver()):
            await asyncio.sleep(120.0)
        assert bench.scans == []
        assert "RT" in words
        assert "RB" in words

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

    @faked(UST_10LX)
    async def test_error_state_is_answered_with_a_reboot(self, bench: Bench) -> None:
        words = heard(bench)
        driver = bench.driver()
        async with bench.running(driver):
            await bench.more(20, 6.0, driver)
            bench.order('[[fault]]\nwhat = "error"')
            await asyncio.sleep(0.02)
            await bench.more(20, 12.0, driver)
        assert words.count("RB") == 2

    @faked()
    async def test_self_check_is_waited_for(self, bench: Bench) -> None:
        """21, seconds of nothing, 98: the sensor verifies a doubt; resetting it then would start all over."""
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
