"""Sensors that are not ready, deny what is not needed, or report themselves in unusual words: scans all the same."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from hal.fake.lidar.models import MODELS, UST_10LX, UTM_30LX, LidarModel, Unit
from hal.hokuyo.sensor_errors import NotReady, StartingUp
from tests.hal.hokuyo.bench import Bench, error_of, faked, on_fake

UTM_EW = replace(UTM_30LX, modl="UTM-30LX-EW[Hokuyo]", prod="UTM-30LX-EW", link="ethernet")


def times_of(bench: Bench, word: str) -> list[float]:
    """When ``word`` was sent to the fake, in seconds from now on."""
    assert bench.fake is not None
    times: list[float] = []
    receive, began = bench.fake.receive, bench.clock.now()

    def listen(data: bytes) -> None:
        times.extend(bench.clock.now() - began for line in data.split(b"\n") if line == word.encode())
        receive(data)

    bench.fake.receive = listen  # type: ignore[method-assign]  # a tap
    return times


def not_ready(by_s: float, status: str = "0M", mode: str = "") -> str:
    return f'[[fault]]\nwhat = "not_ready"\nby_s = {by_s}\nstatus = "{status}"\nmode = "{mode}"'


async def first_scan(bench: Bench, within: float) -> float:
    """Seconds until the first scan."""
    began = bench.clock.now()
    driver = bench.driver()
    await bench.deliver(driver, 1, within)
    return bench.clock.now() - began


@pytest.mark.parametrize("status", ["0M", "0E", "10"])
@pytest.mark.parametrize("model", [UTM_30LX, UTM_EW, UST_10LX, MODELS["URG-04LX-UG01"]], ids=lambda model: model.prod)
def test_a_sensor_that_is_not_ready_for_a_minute_is_awaited(model: LidarModel, status: str) -> None:
    async def body(bench: Bench) -> None:
        reboots, resets = times_of(bench, "RB"), times_of(bench, "RS") + times_of(bench, "RT")
        bench.order(not_ready(60.0, status))
        driver = bench.driver()
        async with bench.running(driver):
            await asyncio.sleep(30.0)
            assert isinstance(error_of(driver), NotReady)
            assert f"MD answers {status}: not now" in str(error_of(driver))
            await bench.more(1, 35.0, driver)
        assert (reboots, resets) == ([], [])

    on_fake(body, model)


@pytest.mark.parametrize("status", ["0M", "0E", "10", "0L"])
@faked(UST_10LX)
async def test_reboots_at_growing_distances_end_when_the_sensor_needs_longer(bench: Bench, status: str) -> None:
    """Each reboot begins the time anew that the sensor needs."""
    needed = 150.0
    reboots = times_of(bench, "RB")
    bench.order(not_ready(needed, status))
    took = await first_scan(bench, 2000.0)
    times = np.array(reboots[1::2])  # the second of each pair takes effect
    assert len(times) >= 1
    gaps = np.diff(times)
    assert (gaps[1:] > 1.8 * gaps[:-1]).all(), gaps
    assert took < times[-1] + 1.0 + UST_10LX.boot_s + needed + 5.0


@pytest.mark.parametrize(("status", "mode"), [("0M", "001 Booting"), ("10", "Starting up"), ("0E", "006 Waking up")])
@faked(UTM_EW)
async def test_a_sensor_that_reports_its_start_is_never_rebooted_nor_reset(
    bench: Bench, status: str, mode: str
) -> None:
    words = [times_of(bench, word) for word in ("RB", "RS", "RT")]
    bench.order(not_ready(1800.0, status, mode))
    driver = bench.driver()
    async with bench.running(driver):
        await asyncio.sleep(1700.0)
        assert isinstance(error_of(driver), StartingUp)
        assert f"the sensor reports: {mode}" in str(error_of(driver))
        await bench.more(1, 105.0, driver)
    assert words == [[], [], []]


@pytest.mark.parametrize("model", [UTM_30LX, UST_10LX], ids=["2.0", "2.2"])
def test_a_slow_boot_is_awaited(model: LidarModel) -> None:
    """While it boots, a UST answers no query, and a UTM refuses to measure."""

    async def body(bench: Bench) -> None:
        reboots = times_of(bench, "RB")
        bench.order('[[fault]]\nwhat = "boot_delay"\nby_s = 59.0')
        bench.order('[[fault]]\nwhat = "reset"')
        assert await first_scan(bench, 65.1) >= 60.0
        assert reboots == []

    on_fake(body, model)


@pytest.mark.parametrize("what", ["off", "silence", "hangup"])
@pytest.mark.parametrize("model", [UTM_30LX, UST_10LX, MODELS["URG-04LX"]], ids=lambda model: model.prod)
def test_a_sensor_that_is_away_for_a_minute_is_back_soon(model: LidarModel, what: str) -> None:
    rs232 = model.link == "rs232"

    async def body(bench: Bench) -> None:
        bench.order(f'[[fault]]\nwhat = "{what}"\nfor = 60.0')
        boot_s = model.boot_s if what == "off" else 0.0
        assert await first_scan(bench, 60.0 + boot_s + (9.0 if rs232 else 5.0)) >= 60.0

    on_fake(body, model, device="/dev/ttyUSB7" if rs232 else "/dev/ttyACM7")


ODD = {
    "VV denied": ('what = "denied"', 2.0),
    "VV denied, not stable": ('what = "denied"\nstatus = "0M"', 2.0),
    "VV unknown": ('what = "denied"\nstatus = "0C"', 2.0),
    "VV silent": ('what = "ignore"', 4.0),
    "II denied": ('what = "denied"\ncommand = "II"', 2.0),
    "II silent": ('what = "ignore"\ncommand = "II"', 4.0),
    "Latin-1": ('what = "vendor"', 2.0),
    "control characters": ('what = "vendor"\ntext = "a\\u0000\\u0007\\r\\u007f"', 2.0),
    "every byte above 127": (f'what = "vendor"\ntext = "{"".join(map(chr, range(128, 256)))}"', 2.0),
}


@pytest.mark.parametrize(("order", "within"), ODD.values(), ids=ODD)
@pytest.mark.parametrize("model", [UTM_30LX, UST_10LX], ids=["2.0", "2.2"])
def test_nothing_but_pp_is_needed_to_measure(model: LidarModel, order: str, within: float) -> None:
    async def body(bench: Bench) -> None:
        bench.order("[[fault]]\n" + order.replace('"ignore"', '"ignore"\ncommand = "VV"', "command" not in order))
        driver = bench.driver()
        await bench.deliver(driver, 3, within)
        assert driver.geometry is not None
        assert driver.geometry.model == model.modl.partition("[")[0] or driver.geometry.model == model.modl
        if "VV" not in order and "vendor" in order:
            assert driver.geometry.serial == "H0706400"
        if "denied" in order and "II" not in order:
            assert driver.geometry.serial == ""

    on_fake(body, model)


@faked()
async def test_a_sensor_without_a_readable_serial_number_is_not_the_one_that_is_named(bench: Bench) -> None:
    bench.order('[[fault]]\nwhat = "denied"')
    driver = bench.driver(serial="H0706400")
    async with bench.running(driver):
        await asyncio.sleep(3.0)
        assert "gives no readable serial number, not H0706400" in str(error_of(driver))
        assert bench.scans == []


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("SCAN", "2400[rpm]", {"period_s": 0.025}),
        ("SCAN", "2400 rpm", {"period_s": 0.025}),
        ("SCAN", "2400(40Hz)", {"period_s": 0.025}),
        ("SCAN", "2400.0", {"period_s": 0.025}),
        ("DMAX", "30000[mm]", {"dmax": 30000}),
        ("DMIN", "23 mm", {"dmin": 23}),
        ("AMAX", "1080<-Default setting by user", {"amax": 1080}),
        ("AFRT", "1440", {"afrt": 1440}),
        ("AFRT", "-60", {"afrt": -60}),
        ("MODL", "H\xf6kuy\xf6-7", {"model": "H?kuy?-7"}),
    ],
)
@faked()
async def test_parameters_in_other_words_are_read(
    bench: Bench, key: str, value: str, expected: dict[str, object]
) -> None:
    bench.order(f'[[fault]]\nwhat = "parameter"\nkey = "{key}"\nvalue = "{value}"')
    driver = bench.driver()
    await bench.deliver(driver, 30, 3.0)
    assert {name: getattr(driver.geometry, name) for name in expected} == expected


@pytest.mark.parametrize("dmin", [0, 1, 20, 100])
@pytest.mark.parametrize("dmax", [30000, 65533, 100000, 262143])
@pytest.mark.parametrize("value", [0, 1, 19, 65533, 65535, 262143])
@faked(replace(UTM_30LX, modl="NEW-50LX", prod="NEW-50LX"))
async def test_codes_are_no_distances_whatever_the_sensor_states(
    bench: Bench, dmin: int, dmax: int, value: int
) -> None:
    bench.order(f'[[fault]]\nwhat = "parameter"\nkey = "DMIN"\nvalue = "{dmin}"')
    bench.order(f'[[fault]]\nwhat = "dmax"\nvalue = {dmax}')
    bench.order(f'[[fault]]\nwhat = "codes"\nvalue = {value}\nbeams = 1.0')
    (scan, *_) = await bench.deliver(bench.driver(), 1, 3.0)
    assert (scan.ranges == 0).all()
    assert (scan.code == value).all()


@faked(MODELS["UXM-30LX-E"])
async def test_ranges_beyond_the_codes_are_distances_where_the_sensor_has_them(bench: Bench) -> None:
    bench.order('[[fault]]\nwhat = "codes"\nvalue = 70000\nbeams = 1.0')
    (scan, *_) = await bench.deliver(bench.driver(), 1, 3.0)
    assert (scan.ranges == 70000).all()


TROUBLE = "Trouble!! Error No. =[00->33]"


@pytest.mark.parametrize(
    "order",
    [
        'what = "status"\ncode = 60',
        'what = "intermittent"\nshare = 1.0',
        'what = "stuck"',
        'what = "not_ready"\nby_s = 100.0',
        'what = "not_ready"\nby_s = 100.0\nstatus = "0A"',
    ],
)
@pytest.mark.parametrize("model", [UTM_30LX, UST_10LX], ids=["2.0", "2.2"])
def test_the_sensors_own_report_is_part_of_the_fault(model: LidarModel, order: str) -> None:
    async def body(bench: Bench) -> None:
        driver = bench.driver()
        seen: set[str] = set()
        async with bench.running(driver):
            await bench.more(5, 6.0, driver)
            bench.order(f'[[fault]]\nwhat = "trouble"\ntext = "{TROUBLE}"')
            bench.order("[[fault]]\n" + order)
            if "not_ready" in order:
                bench.order('[[fault]]\nwhat = "inject"\ntext = "QT\\n"')
            for _ in range(200):
                await asyncio.sleep(0.05)
                seen.add(str(driver.status.error))
        assert any(f"the sensor reports: {TROUBLE}" in said for said in seen), seen

    on_fake(body, model)


@faked(UST_10LX)
async def test_the_report_of_the_error_state_is_part_of_the_fault(bench: Bench) -> None:
    """0L at the start: II is answered, RB ends it."""
    await bench.say(b"MD0100020001000\n")
    bench.order('[[fault]]\nwhat = "error"\ncode = 70')
    driver = bench.driver()
    async with bench.running(driver):
        await asyncio.sleep(1.0)
        assert "0L" in str(error_of(driver))
        assert "the sensor reports: Trouble!! Error No. =[00->70]" in str(error_of(driver))
        await bench.more(5, 10.0, driver)


@pytest.mark.parametrize(("cluster", "baud", "beams"), [(2, 115200, 341), (3, 57600, 227)])
def test_grouped_steps_have_the_bearing_and_time_of_their_middle(cluster: int, baud: int, beams: int) -> None:
    """An incomplete last group is left out: its middle is elsewhere."""
    model = MODELS["URG-04LX"]

    async def body(bench: Bench) -> None:
        assert bench.scene is not None
        scans = await bench.deliver(bench.driver(baud=baud), 60, within=40.0)
        scan = scans[-1]
        assert (scan.stride, len(scan.ranges), len(scan.code)) == (cluster, beams, beams)
        bearings = scan.geometry.bearings(scan.first_step, scan.stride, len(scan.ranges))
        middles = [np.mean(range(44 + cluster * i, 44 + cluster * (i + 1))) for i in range(beams)]
        assert np.allclose(bearings, (np.array(middles) - 384) * 2.0 * np.pi / 1024)
        middle = (44 + 0.5 * (cluster - 1)) * model.true_period_s / model.ares
        early = [scan.t_mono - min(bench.scene.starts, key=lambda t: abs(t + middle - scan.t_mono)) for scan in scans]
        assert np.abs(np.array(early[20:]) - middle).max() < 1e-3

    on_fake(body, model, Unit(clock_gain=50e-6), device="/dev/ttyUSB7")
