"""The session against a sensor that says exactly what a script tells it to, word by word."""

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from hal.clock import LoopClock, run_virtual
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.hokuyo.payload import ScanRequest
from hal.hokuyo.scip_line import Line
from hal.hokuyo.sensor_errors import AbnormalState, NotReady, SelfReport
from hal.hokuyo.session import Session
from hal.port.port import MemoryPort, memory_pair
from tests.hal.hokuyo import encoder

OK = "00"


class Scripted:
    """Answers each command with the next of its replies; the last one repeats. None is silence, bytes go verbatim."""

    def __init__(self, **replies: list[str | bytes | None]) -> None:
        self.replies = {name.replace("_", "."): list(said) for name, said in replies.items()}
        self.received: list[str] = []
        self.bauds: list[int] = []

    def plug(self, port: MemoryPort) -> None:
        self.port = port
        port.start(self._hear, lambda error: None)

    def _hear(self, data: bytes, _t: float) -> None:
        for line in data.split(b"\n"):
            if line:
                self._answer(line.decode())

    def _answer(self, line: str) -> None:
        self.received.append(line)
        self.bauds.append(self.port.peer_baud)
        said = self.replies.get(line) or self.replies.get(line[:2]) or [None]
        reply = said.pop(0) if len(said) > 1 else said[0]
        if isinstance(reply, bytes):
            self.port.write(reply)
        elif reply is not None:
            self.port.write(encoder.answer(line, reply))


def opened(script: Scripted, baud: int = 0) -> Session:
    ours, theirs = memory_pair(LoopClock(asyncio.get_running_loop()), "/dev/x")
    script.plug(theirs)
    ours.set_baud(baud)
    return Session(Line(ours), baud)


def with_session(script: Scripted, body: Callable[[Session], Awaitable[None]]) -> None:
    async def main() -> None:
        await body(opened(script))

    run_virtual(main())


GOOD = {"VV": [encoder.text("VV", encoder.VV_UTM)], "PP": [encoder.text("PP", encoder.PP_UTM)]}


class TestSettle:
    def run(self, script: Scripted) -> None:
        with_session(script, lambda session: session.settle())

    def test_idle(self) -> None:
        script = Scripted(QT=[OK])
        self.run(script)
        assert script.received == ["QT"]

    def test_qt_ignored_twice(self) -> None:
        script = Scripted(QT=[None, None, OK])
        self.run(script)
        assert script.received == ["QT"] * 3

    @pytest.mark.parametrize("status", ["0E", "10"])
    def test_time_adjustment(self, status: str) -> None:
        script = Scripted(QT=[status, OK], TM2=[OK])
        self.run(script)
        assert script.received == ["QT", "TM2", "QT"]

    @pytest.mark.parametrize("answer", [b"QT\nE\n\n", b"QT\n0\n\n"])
    @pytest.mark.parametrize("switch", [b"SCIP2.0\n0\n\n", b"SCIP2.0\n0Ee\n\n", None])
    def test_scip_1(self, answer: bytes, switch: bytes | None) -> None:
        script = Scripted(QT=[answer, OK], SCIP2_0=[switch])
        self.run(script)
        assert script.received == ["QT", "SCIP2.0", "QT"]

    def test_a_damaged_reply_is_asked_for_again(self) -> None:
        script = Scripted(QT=[b"QT\n00Q\n\n", OK])
        self.run(script)
        assert script.received == ["QT", "QT"]

    def test_frames_of_a_running_stream_are_passed_over(self) -> None:
        frame = encoder.scan("MD0000000201000", 1, "0CB1Dh7D`")
        script = Scripted(QT=[frame[7:] + frame + frame + encoder.answer("QT", OK)])
        self.run(script)
        assert script.received == ["QT"]

    def test_mute(self) -> None:
        with pytest.raises(DeviceFault, match=r"/dev/x: no reply .*HOKUYO"):
            self.run(Scripted())

    def test_noise(self) -> None:
        with pytest.raises(DeviceFault, match="only unreadable bytes arrive"):
            self.run(Scripted(QT=[b"\x80" * 300]))

    @pytest.mark.parametrize(
        ("said", "shown"),
        [
            (b"$GPGGA,123519,4807.038,N\r\n", r"'\$GPGGA,123519,4807\.0'"),
            (b"\nQT\n", "'QT..QT..QT'"),
            (b"\x00\xffhello\n\n", r"'\.\.hello"),
        ],
        ids=["NMEA", "echo", "half of it no letters"],
    )
    def test_what_talks_and_is_no_lidar_is_shown(self, said: bytes, shown: str) -> None:
        with pytest.raises(DeviceFault, match=f"only unreadable bytes arrive .*does not use SCIP, {shown}") as told:
            self.run(Scripted(QT=[said]))
        assert told.value.problem == "only unreadable bytes arrive", "it is logged once for this text"

    def test_abnormal(self) -> None:
        with pytest.raises(AbnormalState, match=r"0L.*power off and on"):
            self.run(Scripted(QT=["0L"]))

    def test_never_idle(self) -> None:
        with pytest.raises(DeviceFault, match="does not become idle, QT answers 0E"):
            self.run(Scripted(QT=["0E"], TM2=["0E"]))
        with pytest.raises(DeviceFault, match=r"does not become idle, QT answers as SCIP 1\.1"):
            self.run(Scripted(QT=[b"QT\nE\n\n"]))

    def test_port_lost(self) -> None:
        script = Scripted(QT=[None])

        async def body(session: Session) -> None:
            asyncio.get_running_loop().call_later(0.1, script.port.close)
            with pytest.raises(DeviceMissing):
                await session.settle()
            with pytest.raises(DeviceMissing):
                await session.settle()

        with_session(script, body)


@pytest.mark.virtual
class TestReset:
    async def test_before_anything_is_known_only_rs(self) -> None:
        script = Scripted(RS=[None, OK], QT=[OK])
        await opened(script).reset()
        assert script.received == ["RS", "RS", "QT"]

    async def test_a_model_that_has_rt_keeps_its_rate(self) -> None:
        script = Scripted(RT=[OK], QT=[OK], **GOOD)
        session = opened(script)
        await session.identify()
        await session.reset()
        assert "RT" in script.received
        assert "RS" not in script.received

    async def test_rs_on_a_serial_line_means_finding_the_rate_again(self) -> None:
        script = Scripted(RS=[OK], QT=[None, None, OK])
        session = opened(script, baud=115200)
        await session.reset()
        assert session.baud == 57600

    async def test_no_answer(self) -> None:
        with pytest.raises(DeviceFault, match="does not answer a reset"):
            await opened(Scripted()).reset()

    async def test_reboot_is_a_pair_and_never_raises(self) -> None:
        script = Scripted(RB=["01", OK])
        session = opened(script)
        began = asyncio.get_running_loop().time()
        await session.reboot()
        assert script.received == ["RB", "RB"]
        assert asyncio.get_running_loop().time() - began < 4.0
        script.port.close()
        await asyncio.sleep(0)
        await session.reboot()


@pytest.mark.virtual
class TestIdentify:
    async def test_good(self) -> None:
        script = Scripted(**GOOD, II=[encoder.text("II", [("STAT", "Sensor works well.")])])
        session = opened(script)
        who = await session.identify()
        assert (who.geometry.serial, session.report.health) == ("H0900001", "Sensor works well.")
        assert script.received == ["VV", "PP", "II"]

    async def test_without_ii(self) -> None:
        session = opened(Scripted(**GOOD, QT=[OK]))
        await session.identify()
        assert session.report == SelfReport()

    async def test_left_in_time_adjustment_by_firmware_that_grants_qt_there(self) -> None:
        script = Scripted(VV=["0E", *GOOD["VV"]], PP=GOOD["PP"], TM2=[OK], QT=[OK])
        await opened(script).identify()
        assert script.received[:3] == ["VV", "TM2", "QT"]

    async def test_damaged_once(self) -> None:
        damaged = GOOD["PP"][0].replace(b"1080", b"1081")
        script = Scripted(VV=GOOD["VV"], PP=[damaged, *GOOD["PP"]])
        session = opened(script)
        assert (await session.identify()).geometry.amax == 1080
        assert script.received.count("PP") == 2

    async def test_the_same_wrong_sum_twice_is_the_firmwares_own_way(self) -> None:
        odd = GOOD["VV"][0].replace(b"SERI:H0900001;" + GOOD["VV"][0].rstrip()[-1:], b"SERI:H0900001;0")
        script = Scripted(VV=[odd], PP=GOOD["PP"])
        session = opened(script)
        assert (await session.identify()).geometry.serial == "H0900001"
        assert script.received.count("VV") == 2

    async def test_never_readable(self) -> None:
        replies: list[str | bytes | None] = [GOOD["PP"][0].replace(b"1080", b"108%d" % i) for i in range(1, 9)]
        with pytest.raises(DeviceFault, match="PP: checksum"):
            await opened(Scripted(VV=GOOD["VV"], PP=replies)).identify()

    async def test_vv_that_is_never_readable_is_not_needed(self) -> None:
        others = (
            b"H09%05d" % i for i in range(20, 60) if sum(map(int, str(i))) not in (1, 6)
        )  # sums with and without ;
        replies: list[str | bytes | None] = [GOOD["VV"][0].replace(b"H0900001", other) for other in others]
        session = opened(Scripted(VV=replies, PP=GOOD["PP"]))
        assert (await session.identify()).geometry.serial == ""

    @pytest.mark.parametrize("answer", ["10", "0E", "0M", None])
    async def test_pp_refused_or_not_answered_is_a_sensor_that_starts(self, answer: str | None) -> None:
        with pytest.raises(NotReady, match="PP: "):
            await opened(Scripted(QT=[OK], TM2=["10"], VV=[answer], PP=[answer])).identify()

    async def test_no_lidar(self) -> None:
        script = Scripted(VV=GOOD["VV"], PP=[encoder.text("PP", [("MODL", "Coffee machine")])])
        with pytest.raises(DeviceRefused, match="PP reply has DMIN='', expected a number"):
            await opened(script).identify()


@pytest.mark.virtual
class TestRate:
    async def test_accepted(self) -> None:
        script = Scripted(SS=[OK], **GOOD)
        session = opened(script, baud=19200)
        await session.set_rate(250000)
        assert session.baud == 250000
        assert script.received == ["SS250000", "VV"]
        assert script.bauds == [19200, 250000]

    @pytest.mark.parametrize("status", ["02", "04", "0F", None])
    async def test_refused(self, status: str | None) -> None:
        session = opened(Scripted(SS=[status]), baud=19200)
        await session.set_rate(250000)
        assert session.baud == 19200

    async def test_lost_on_the_way(self) -> None:
        with pytest.raises(DeviceFault, match="lost after the change to 250000"):
            await opened(Scripted(SS=[OK]), baud=19200).set_rate(250000)

    async def test_an_adapter_that_cannot_do_it_is_found_out_before_the_sensor_changes(self) -> None:
        script = Scripted(SS=[OK], QT=[OK])
        session = opened(script, baud=19200)
        port = session.line.port
        assert isinstance(port, MemoryPort)
        plain = port.set_baud

        def limited(baud: int) -> None:
            if baud > 115200:
                raise DeviceRefused("/dev/x", f"cannot do {baud} bit/s")
            plain(baud)

        port.set_baud = limited  # type: ignore[method-assign]  # an adapter with limits
        with pytest.raises(DeviceRefused):
            await session.set_rate(250000)
        assert script.received == []
        assert port.baud == 19200
        await session.find_rate(750000)
        assert session.baud == 19200

    async def test_any_frame_betrays_the_right_rate(self) -> None:
        """A sensor that streams may take long to say so; a frame of its stream is answer enough."""
        frame = encoder.scan("MD0000000201000", 1, "0CB1Dh7D`")
        script = Scripted(QT=[None, None, frame])
        session = opened(script)
        await session.find_rate()
        assert session.baud == 57600

    async def test_no_rate(self) -> None:
        script = Scripted()
        with pytest.raises(DeviceFault, match="no reply at any line rate"):
            await opened(script).find_rate(250000)
        assert script.bauds == [250000, 19200, 38400, 57600, 115200, 500000, 750000]

    async def test_what_talks_and_is_no_lidar_is_shown_as_it_is_read_best(self) -> None:
        """At all rates but its own it is no text."""
        noise = b"\x80\xf8\x00" * 10
        script = Scripted(QT=[None, noise, b"$GPRMC,1235\r\n", noise])
        with pytest.raises(DeviceFault, match=r"only unreadable bytes arrive .*'\$GPRMC,1235': name the lidar's port"):
            await opened(script).find_rate()


class TestStart:
    request = ScanRequest("MD", 0, 2)
    line = "MD0000000201000"

    def start(self, script: Scripted, scans: bool = False) -> list[bytes]:
        frames: list[bytes] = []

        async def body(session: Session) -> None:
            await session.start(self.request, lambda frame, t: frames.append(frame), lambda: scans and bool(frames))
            await asyncio.sleep(0.1)

        with_session(script, body)
        return frames

    def test_acknowledged(self) -> None:
        data = encoder.scan(self.line, 1, "0CB1Dh7D`")
        script = Scripted(MD=[encoder.answer(self.line, OK) + data])
        assert self.start(script) == [data[:-2]]
        assert script.received == [self.line]

    def test_acknowledgement_lost_but_data_come(self) -> None:
        script = Scripted(MD=[encoder.scan(self.line, 1, "0CB1Dh7D`")])
        assert len(self.start(script, scans=True)) == 1
        assert script.received == [self.line]

    def test_no_answer_at_all(self) -> None:
        with pytest.raises(DeviceFault, match="does not acknowledge MD"):
            self.start(Scripted())

    @pytest.mark.parametrize(
        ("status", "kind", "words"),
        [
            ("04", DeviceRefused, "the sensor rejects the range that it states"),
            ("10", DeviceFault, "not now"),
            ("0L", AbnormalState, "error state"),
            ("60", DeviceFault, "hardware fault"),
            ("30", DeviceFault, "the sensor runs a self-test"),
            ("0A", DeviceFault, "MD answers 0A"),
        ],
    )
    def test_refusals(self, status: str, kind: type[HalError], words: str) -> None:
        with pytest.raises(kind, match=words):
            self.start(Scripted(MD=[status]))


def test_quiet_never_takes_long_and_never_raises() -> None:
    async def body(session: Session) -> None:
        loop = asyncio.get_running_loop()
        began = loop.time()
        await session.quiet()
        assert loop.time() - began == pytest.approx(0.1)
        session.line.close()
        await session.quiet()

    with_session(Scripted(), body)
