"""What a sensor refuses, with which status, and how lines of the host are read."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from hal.fake.lidar.models import URG_04LX, UST_10LX, UTM_30LX, Unit
from tests.hal.fake.bench import Talk, talking, virtual


@pytest.mark.parametrize(
    ("command", "status"),
    [
        ("MDx000108000000", "01"),
        ("MD000x108000000", "01"),
        ("MD0000x08000000", "02"),
        ("MD00001080x0000", "03"),
        ("MD000010800xx00", "03"),
        ("MD00001080010x0", "07"),
        ("MD0000108000x00", "06"),
        ("MD000010800000x", "07"),
        ("MD0000108100000", "04"),
        ("MD0540053900000", "05"),
        ("GD0000108000", "10"),
        ("MD000010800000", "0C"),
        ("MD00001080000000", "0D"),
        ("VV1", "0D"),
        ("TM", "0C"),
        ("TM11", "0D"),
        ("VV;12345678901234567", "0G"),
        ("VV;tag-1", "0H"),
        ("VV;a b._+@1", "00"),
        ("ND0000108000000", "0E"),  # a UTM-30LX by USB has no multi-echo
        ("%TM1", "0E"),
        ("vv", "0E"),
        ("AT", "0E"),
        ("V", "0E"),
        ("CR00", "04"),
        ("SS115200", "00"),
        ("SS019200", "03"),
        ("SS01920", "0C"),
        ("SSabcdef", "01"),
        ("SS123456", "02"),
        ("HS0", "02"),
        ("HS1", "00"),
        ("HS2", "01"),
    ],
)
def test_refusals(command: str, status: str) -> None:
    assert virtual(lambda talk: talk.status(command)) == status


def test_start_below_amin_is_refused() -> None:
    assert virtual(lambda talk: talk.status("MD0043072500000"), URG_04LX) == "04"


@talking(replace(URG_04LX, amin=0, amax=1080))
async def test_status_lines_are_byte_exact(talk: Talk) -> None:
    raw = b""
    for line in ("GD0540054201", "XX", "BM", "BM", "GD0540200001", "CR00"):
        await talk.ask(line, 0.1)
        raw += talk.raw
    expected = b"GD0540054201\n10Q\n\nXX\n0Ee\n\nBM\n00P\n\nBM\n02R\n\nGD0540200001\n04T\n\nCR00\n03S\n\n"
    assert raw == expected


@pytest.mark.parametrize("text", ["VV\n", "VV\r", "VV\r\n", "\nVV\n", "\n\n\rVV\n\n"])
@talking()
async def test_ends_of_line(talk: Talk, text: str) -> None:
    talk.say(text)
    await asyncio.sleep(0.1)
    assert talk.raw.count(b"VV\n00P\n") == 1


@talking()
async def test_a_line_may_come_in_pieces(talk: Talk) -> None:
    for char in "TM1;a7\n":
        talk.say(char)
        await asyncio.sleep(0.01)
    await asyncio.sleep(0.1)
    assert [reply.echo for reply in talk.replies()] == ["TM1;a7"]


@talking()
async def test_an_endless_line_is_cut_and_refused(talk: Talk) -> None:
    for _ in range(50):
        talk.say("A" * 1000)
    talk.say("\nVV\n")
    await asyncio.sleep(0.2)
    replies = talk.replies()
    assert len(replies[0].echo) < 300
    assert [reply.status for reply in replies] == ["0E", "00"]


@talking()
async def test_bytes_that_are_no_ascii_are_echoed_and_refused(talk: Talk) -> None:
    talk.say("\xff\xfe\x00\n")
    await asyncio.sleep(0.1)
    assert talk.raw == b"\xff\xfe\x00\n0Ee\n\n"


@talking()
async def test_different_commands_queue_and_the_same_one_is_refused_once(talk: Talk) -> None:
    talk.say("VV\nPP\nVV\nVV\nII\n")
    await asyncio.sleep(0.2)
    assert [(reply.echo, reply.status) for reply in talk.replies()] == [
        ("VV", "00"),
        ("VV", "0B"),
        ("PP", "00"),
        ("II", "00"),
    ]


def test_a_tag_is_echoed_and_the_stamp_is_the_clock() -> None:
    async def scene(talk: Talk) -> bytes:
        talk.say("TM1;a7\n")
        await asyncio.sleep(0.1)
        return talk.raw

    still = replace(UTM_30LX, latency_s=0.0, jitter_s=0.0)
    assert virtual(scene, still, unit=Unit(clock_ms=0x123456)) == b"TM1;a7\n00P\n4SAF>\n\n"


@talking(URG_04LX, unit=Unit(serial="H0706400", clock_ms=0x6A5404 - 1000))
async def test_urg_04lx_says_what_a_real_one_said(talk: Talk) -> None:
    talk.say("VV\nPP\nII\n")
    await asyncio.sleep(0.5)
    raw = talk.raw.decode()
    vv, pp, ii, rest = raw.split("\n\n")
    assert rest == ""
    assert vv == (
        "VV\n00P\nVEND:Hokuyo Automatic Co.,Ltd.;[\nPROD:SOKUIKI Sensor URG-04LX;[\n"
        "FIRM:3.1.04(02/Aug./2007);a\nPROT:SCIP 2.0;N\nSERI:H0706400;F"
    )
    assert pp == (
        "PP\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nDMIN:20;4\nDMAX:5600;_\nARES:1024;\\\n"
        "AMIN:44;7\nAMAX:725;o\nAFRT:384;6\nSCAN:600;e"
    )
    lines = ii.split("\n")
    assert [line.partition(":")[0] for line in lines[2:]] == ["MODL", "LASR", "SCSP", "MESM", "SBPS", "TIME", "STAT"]
    assert lines[2] == "MODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N"
    assert lines[4] == "SCSP:Initial(600[rpm])<-Default setting by user;A"
    assert lines[6] == "SBPS:19200[bps]<-Default setting by user;A"
    assert lines[8] == "STAT:Sensor works well.;8"


@talking(URG_04LX)
async def test_host_at_another_rate_hears_noise(talk: Talk) -> None:
    talk.say("MD0044072500000\n")
    await asyncio.sleep(0.5)
    assert talk.port is not None
    talk.port.set_baud(57600)
    talk.pieces.clear()
    await asyncio.sleep(3.0)
    raw = talk.raw
    assert len(raw) > 2000
    assert len(set(raw)) > 200


@talking(URG_04LX)
async def test_motor_speed(talk: Talk) -> None:
    talk.say("MD0044004400000\n")
    await asyncio.sleep(0.5)
    statuses = [await talk.status(line) for line in ("CR00", "CR11", "CRxx")]
    talk.pieces.clear()
    talk.say("CR10\n")
    await asyncio.sleep(3.0)
    ticks = [scan.tick for scan in talk.scans()]
    assert np.diff(ticks[-10:]) == pytest.approx(100.2 / 0.9, abs=1.0)
    statuses.append(await talk.status("CR10"))
    await talk.ask("RS", 2.0)
    await talk.ask("MD0044004400000", 3.0)
    assert np.diff([scan.tick for scan in talk.scans()]) == pytest.approx(100.2, abs=1.0)
    assert statuses == ["03", "02", "01", "03"]


@talking()
async def test_a_flood_of_commands_does_not_fill_the_memory(talk: Talk) -> None:
    for k in range(10000):
        talk.say(f"TM1;{k}\n")
    await asyncio.sleep(5.0)
    assert len(talk.replies()) <= 40


def test_ethernet_has_no_baud_rate() -> None:
    assert virtual(lambda talk: talk.status("SS115200"), UST_10LX) == "0F"
