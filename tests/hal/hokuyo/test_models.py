"""Models of the sensor, and the errors that they report."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.errors import DataInvalid, DeviceFault, DeviceRefused
from hal.fake.lidar.models import MODELS
from hal.hokuyo.models import UNKNOWN_MODEL, Identity, facts_of, identify, line_speed, stream_request
from hal.hokuyo.sensor_errors import AbnormalState, NotReady, SelfReport, StartingUp, explain_status
from tests.hal.hokuyo import encoder

VV, PP = dict(encoder.VV_UTM), dict(encoder.PP_UTM)


def utm(**changes: str) -> Identity:
    return identify("/dev/x", VV | {k: v for k, v in changes.items() if k in VV}, PP | changes)


def test_geometry_is_what_the_sensor_states() -> None:
    who = utm()
    g = who.geometry
    assert (g.model, g.serial, g.firmware) == ("UTM-30LX", "H0900001", "P.1.05(17/Apr./2009)")
    assert (g.ares, g.afrt, g.amin, g.amax, g.dmin, g.dmax) == (1440, 540, 0, 1080, 23, 60000)
    assert g.period_s == 0.025
    assert g.beam_dt_s == pytest.approx(17.36e-6, rel=1e-3)
    assert who.facts.family == "UTM-30LX"
    assert who.protocol == "SCIP 2.0"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("AMAX", ""),
        ("AMAX", "2000"),
        ("AMIN", "1080"),
        ("ARES", "many"),
        ("ARES", "0"),
        ("ARES", "99999"),
        ("ARES", "\N{SUPERSCRIPT TWO}"),
        ("SCAN", "0"),
        ("SCAN", "9" * 5000),
        ("DMIN", "60000"),
        ("DMIN", "-5"),
        ("AFRT", "2881"),
        ("AFRT", "-2881"),
        ("SCAN", "2,400"),
        ("SCAN", "24e2"),
        ("AMAX", "1080.5"),
        ("AMAX", "1O80"),
        ("AMAX", "0x438"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(key: str, value: str) -> None:
    with pytest.raises(DeviceRefused, match=rf"/dev/x: PP .*{key}.*HOKUYO"):
        utm(**{key: value})


@given(st.dictionaries(st.sampled_from(sorted(PP)), st.text(max_size=8)))
def test_any_parameters_give_an_identity_or_a_refusal(changes: dict[str, str]) -> None:
    try:
        who = utm(**changes)
    except DeviceRefused:
        return
    assert len(who.geometry.bearings(who.geometry.amin, 1, 3)) == 3


def test_missing_parameter_and_no_identity() -> None:
    with pytest.raises(DeviceRefused, match="AFRT=''"):
        identify("/dev/x", VV, {k: v for k, v in PP.items() if k != "AFRT"})
    assert identify("/dev/x", {}, PP).facts.family == "UTM-30LX"


def test_firmware_from_before_scip_2() -> None:
    vv = {"PROD": "SOKUIKI Sensor URG-04LX", "FIRM": "2.9.01(01/Jan./2006)"}
    with pytest.raises(DeviceRefused, match=r"firmware 2\.9.*update"):
        identify("/dev/x", vv, PP | {"MODL": "URG-04LX"})


@pytest.mark.parametrize(
    ("name", "family", "line"),
    [
        ("URG-04LX", "URG-04LX", "usb"),
        ("URG-04LX-UG01", "URG-04LX", "usb"),
        ("UBG-04LX-F01", "UBG-04LX", "usb"),
        ("UHG-08LX", "UHG-08LX", "usb"),
        ("UTM-30LX", "UTM-30LX", "usb"),
        ("UST-10LX", "UST", "ethernet"),
        ("UST-20LX", "UST", "ethernet"),
        ("UXM-30LX-E", "UXM-30LX", "ethernet"),
    ],
)
def test_families(name: str, family: str, line: str) -> None:
    facts = facts_of(MODELS[name].prod, MODELS[name].modl)
    assert (facts.family, facts.line) == (family, line)
    assert facts.allows("MD")
    assert facts.allows("ME") is (family not in ("URG-04LX", "UBG-04LX", "UHG-08LX"))
    assert facts.allows("RB") is (line == "ethernet")


def test_unknown_models_and_the_ethernet_utm() -> None:
    assert facts_of("SOKUIKI Sensor XYZ-9", "XYZ-9") is UNKNOWN_MODEL
    assert facts_of("", "UTM-30LX-EW[Hokuyo]").line == "ethernet"
    assert not facts_of("", "UTM-30LX-EW[Hokuyo]").intensity_swath_deg


def test_codes_are_told_in_words() -> None:
    urg = identify("/dev/x", {"PROD": "URG-04LX", "FIRM": "3.1"}, PP | {"MODL": "URG-04LX", "DMAX": "5600"})
    assert urg.code_text(18) == "reflection too strong"
    assert urg.code_text(13) == "error code without published meaning"
    assert urg.code_text(5601) == "no return"
    assert utm(MODL="NEW-50LX", DMAX="300000").code_text(65533) == "no return"


def test_a_dmax_beyond_what_a_reply_can_carry() -> None:
    assert utm(DMAX="300000").geometry.dmax == 262143


@pytest.mark.parametrize(
    ("bytes_per_s", "cluster", "skip"),
    [(1e6, 1, 0), (75_000, 2, 0), (50_000, 3, 0), (11_520, 3, 3), (1_920, 3, 9)],
)
def test_what_a_line_can_carry(bytes_per_s: float, cluster: int, skip: int) -> None:
    request = stream_request(utm(), intensity=False, bytes_per_s=bytes_per_s)
    assert (request.name, request.cluster, request.skip) == ("MD", cluster, skip)
    if skip < 9:
        assert request.frame_bytes <= bytes_per_s * 0.025 * (skip + 1)


@pytest.mark.parametrize(("firmware", "cluster"), [("P.1.05(17/Apr./2009)", 3), ("1.16.01(16/Nov./2009)", 2)])
def test_intensity_of_a_usb_utm_within_its_limits(firmware: str, cluster: int) -> None:
    request = stream_request(utm(FIRM=firmware), intensity=True, bytes_per_s=1e6)
    assert (request.name, request.cluster) == ("ME", cluster)


@pytest.mark.parametrize(
    ("device", "baud", "rate"),
    [
        ("/dev/ttyACM0", 0, 1.0e6),
        ("tcp://192.168.0.10", 0, 12.5e6),
        ("/dev/ttyUSB0", 115200, 11520.0),
        ("/dev/pts/4", 0, 1.0e6),
    ],
)
def test_line_speeds(device: str, baud: int, rate: float) -> None:
    assert line_speed(device, baud, utm().facts) == rate


def test_the_sensors_own_words_go_with_the_error() -> None:
    report = SelfReport("IDLE", "Trouble!! Error No. =[00->33]")
    assert "Trouble!! Error No. =[00->33]" in str(explain_status("/dev/x", "MD", "50", report))


@pytest.mark.parametrize("health", ["", "Sensor works well.", "Stable 000 no error.", "sensor is working normally"])
def test_a_healthy_report_is_none(health: str) -> None:
    assert "reports" not in str(explain_status("/dev/x", "MD", "50", SelfReport("IDLE", health)))


@pytest.mark.parametrize("health", ["Unstable 100 no error.", "Abnormal state", "Error: laser", "anything else"])
def test_any_other_report_is_repeated_once(health: str) -> None:
    report = SelfReport("IDLE", health)
    error = explain_status("/dev/x", "MD", "50", report)
    assert str(report.added_to(error)).count(health) == 1


@pytest.mark.parametrize(
    ("report", "starting"),
    [
        (SelfReport("001 Booting"), True),
        (SelfReport("IDLE", "Warming up"), True),
        (SelfReport("006 Waking"), True),
        (SelfReport("000 Idle", "Stable 000 no error."), False),
        (SelfReport("Measuring by Normal Mode"), False),
        (SelfReport("IDLE", "Error, restart the sensor"), False),
        (SelfReport("IDLE", "Start failed"), False),
    ],
)
def test_a_report_of_the_start(report: SelfReport, starting: bool) -> None:
    error = explain_status("/dev/x", "MD", "10", report)
    assert isinstance(error, StartingUp) is starting
    assert isinstance(error, NotReady)
    assert not isinstance(explain_status("/dev/x", "MD", "0L", report), StartingUp)


def test_errors_of_the_line_are_not_the_sensors() -> None:
    report = SelfReport("001 Booting", "Trouble")
    damaged = DataInvalid("/dev/x", "a frame was dropped")
    assert report.added_to(damaged) is damaged
    assert isinstance(report.added_to(DeviceFault("/dev/x", "silent")), StartingUp)
    assert isinstance(report.added_to(AbnormalState("/dev/x", "0L")), AbnormalState)
