"""One request in, one answer out: the short way and the codec's way, exceptions, writing."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.publish.modbus import registers
from daemon.publish.modbus.holding import COMMAND, CommandCode, Holding, Outcome, Request, WrittenOdometry
from daemon.publish.modbus.requests import Responder, frame_size
from daemon.system.versions import release
from tests.daemon.publish.modbus.test_registers import snapshot


class Bench:
    """A responder with a snapshot, and what writing set off."""

    def __init__(self, write: bool = True) -> None:
        self.commands: list[Request] = []
        self.odometry: list[WrittenOdometry] = []
        self.loops: list[int] = []
        self.holding = Holding(self.commands.append, self.odometry.append, self.loops.append)
        self.responder = Responder(self.holding if write else None)
        taken = snapshot()
        self.block, self.mirror = registers.encode_block(taken), registers.encode_mirror(taken)
        self.responder.show(self.block, lambda: self.mirror)

    def ask(self, body: bytes, unit: int = 1) -> bytes:
        """Answer's body to a request's body."""
        frame = struct.pack(">HHHB", 0xBEEF, 0, len(body) + 1, unit) + body
        assert frame_size(frame) == len(frame)
        answer = self.responder.answer(frame)
        head, length = struct.pack(">HH", 0xBEEF, 0), struct.pack(">H", len(answer) - 6)
        assert answer[:7] == head + length + bytes([unit])
        return answer[7:]


def read(function: int, address: int, count: int) -> bytes:
    return struct.pack(">BHH", function, address, count)


def write(address: int, *words: int) -> bytes:
    return struct.pack(f">BHHB{len(words)}H", 16, address, len(words), 2 * len(words), *words)


@pytest.mark.parametrize("function", [3, 4])
def test_whole_block(function: int) -> None:
    bench = Bench()
    assert bench.ask(read(function, 0, 64)) == bytes([function, 128]) + bench.block


def test_part_of_the_block_and_of_the_mirror() -> None:
    bench = Bench()
    assert bench.ask(read(4, 18, 6)) == b"\x04\x0c" + bench.block[36:48]
    assert bench.ask(read(4, 63, 1)) == b"\x04\x02" + bench.block[126:]
    assert bench.ask(read(4, 104, 4)) == b"\x04\x08" + bench.mirror[8:16]
    assert bench.ask(read(4, 100, registers.MIRROR_WORDS)) == bytes([4, len(bench.mirror)]) + bench.mirror


@pytest.mark.parametrize(
    ("address", "count", "code"),
    [
        (0, 0, 3), (0, 126, 3), (0, 65535, 3), (9999, 126, 3),
        (0, 65, 2), (63, 2, 2), (64, 1, 2), (99, 2, 2), (100, 59, 2), (65535, 1, 2), (65535, 125, 2), (60, 125, 2),
    ],
)  # fmt: skip
@pytest.mark.parametrize("function", [3, 4])
def test_reads_outside_are_exceptions(function: int, address: int, count: int, code: int) -> None:
    assert Bench().ask(read(function, address, count)) == bytes([function | 0x80, code])


@pytest.mark.parametrize("function", [0, 1, 2, 5, 7, 8, 15, 17, 20, 22, 24, 90, 127, 128, 132, 255])
def test_other_functions_are_illegal(function: int) -> None:
    assert Bench().ask(bytes([function, 0, 0, 0, 1])) == bytes([function | 0x80, 1])
    assert Bench().ask(bytes([function])) == bytes([function | 0x80, 1])


@pytest.mark.parametrize("body", ["04", "04000000", "040000000100", "0300", "0603e800", "1003e8"])
def test_wrong_lengths_are_illegal_values(body: str) -> None:
    request = bytes.fromhex(body)
    assert Bench().ask(request) == bytes([request[0] | 0x80, 3])


@pytest.mark.parametrize("unit", [0, 1, 17, 247, 255])
def test_any_unit_is_answered_and_echoed(unit: int) -> None:
    assert Bench().ask(read(4, 0, 1), unit) == b"\x04\x02\x4c\x4c"


def test_without_permission_writing_is_an_illegal_function() -> None:
    bench = Bench(write=False)
    assert bench.ask(b"\x06\x03\xe8\x00\x01") == b"\x86\x01"
    assert bench.ask(write(1000, 1, 1)) == b"\x90\x01"
    assert bench.ask(read(3, 1000, 10)) == b"\x83\x02"


@given(
    st.integers(0, 0xFFFF), st.integers(0, 255), st.sampled_from([3, 4]),
    st.integers(0, 200) | st.integers(0, 0xFFFF), st.integers(0, 130) | st.integers(0, 0xFFFF),
)  # fmt: skip
def test_the_short_way_gives_the_codecs_bytes(
    transaction: int, unit: int, function: int, address: int, count: int
) -> None:
    responder = Bench().responder
    frame = struct.pack(">HHHBBHH", transaction, 0, 6, unit, function, address, count)
    assert responder.answer(frame) == responder.answer_any(frame)


def test_an_empty_frame_size() -> None:
    assert frame_size(b"") == 0
    assert frame_size(b"\x00\x01\x00\x00\x00\x06\x01") == 0
    assert frame_size(b"\x00\x01\x00\x00\x00\x06\x01\x04") == 12
    for bad in (b"\x00\x01\x00\x01\x00\x06\x01\x04", b"\x00\x01\x01\x00\x00\x06\x01\x04"):
        assert frame_size(bad) == -1
    for length in (0, 1, 255, 256, 65535):
        assert frame_size(b"\x00\x01\x00\x00" + length.to_bytes(2, "big") + b"\x01\x04") == -1
    assert frame_size(b"\x00\x01\x00\x00\x00\xfe\x01\x04") == 260


# --- writing ---------------------------------------------------------------------------------------------------------

SET_POSE = (1, 0, 12_345, 0xFFFF, 0xFFFF, 0x0010, 0x0000)  # SET_POSE at x 1.2345, y -0.0001, yaw 1.048576


def result(bench: Bench) -> tuple[int, int]:
    return struct.unpack(">HH", bench.ask(read(3, 1008, 2))[2:])  # type: ignore[return-value]  # two words, by format


def test_a_command_in_one_request() -> None:
    bench = Bench()
    assert bench.ask(write(1000, 5, *SET_POSE)) == struct.pack(">BHH", 16, 1000, 8)
    (command,) = bench.commands
    assert (command.number, command.code.name) == (5, "SET_POSE")
    assert command.pose == (1.2345, -0.0001, 1.048576)
    assert result(bench) == (0, Outcome.RUNNING)
    bench.holding.acknowledge(5, Outcome.DONE)
    assert result(bench) == (5, Outcome.DONE)


def test_a_command_register_by_register() -> None:
    bench = Bench()
    for number, word in enumerate(SET_POSE, 1001):
        assert bench.ask(struct.pack(">BHH", 6, number, word)) == struct.pack(">BHH", 6, number, word)
    assert bench.commands == []
    bench.ask(struct.pack(">BHH", 6, 1000, 9))
    assert [c.number for c in bench.commands] == [9]


def test_a_repeated_request_is_not_a_second_command() -> None:
    bench = Bench()
    for _ in range(3):
        bench.ask(write(1000, 5, *SET_POSE))
    assert len(bench.commands) == 1


def test_a_newer_command_replaces_a_running_one() -> None:
    bench = Bench()
    bench.ask(write(1000, 5, *SET_POSE))
    bench.ask(write(1000, 6, 2))
    bench.holding.acknowledge(5, Outcome.DONE)
    assert result(bench) == (0, Outcome.RUNNING)
    bench.holding.acknowledge(6, Outcome.REFUSED)
    assert result(bench) == (6, Outcome.REFUSED)


@pytest.mark.parametrize("code", [0, 9, 65535])
def test_an_unknown_command_says_so(code: int) -> None:
    bench = Bench()
    bench.ask(write(1000, 5, code))
    assert bench.commands == []
    assert result(bench) == (5, Outcome.UNKNOWN)


def test_a_map_to_switch_to_is_written_before_the_request() -> None:
    bench = Bench()
    bench.ask(write(1010, 0xDEAD, 0xBEEF))
    bench.ask(write(1000, 5, CommandCode.SWITCH_MAP))
    assert [(r.code, r.map_id) for r in bench.commands] == [(CommandCode.SWITCH_MAP, 0xDEADBEEF)]
    assert bench.ask(read(3, 1010, 2)) == b"\x03\x04\xde\xad\xbe\xef"


def test_a_loop_is_acknowledged_by_its_count() -> None:
    bench = Bench()
    bench.ask(write(1050, 65535))
    assert bench.ask(b"\x06\x04\x1a\x00\x07") == b"\x06\x04\x1a\x00\x07"
    assert bench.loops == [65535, 7]
    assert bench.ask(read(3, 1050, 1)) == b"\x03\x02\x00\x07"
    assert bench.ask(write(1050, 1, 2)) == b"\x90\x02"
    assert bench.ask(read(3, 1049, 2)) == b"\x83\x02"


def test_a_pose_that_is_not_known_is_refused() -> None:
    bench = Bench()
    bench.ask(write(1000, 5, 1, 0x8000, 0, 0, 0, 0, 0))
    assert bench.commands == []
    assert result(bench) == (5, Outcome.REFUSED)


@pytest.mark.parametrize(
    "body",
    [
        write(0, 1), write(999, 1, 1), write(1008, 1), write(1007, 1, 1), write(1009, 1, 1), write(1011, 1, 1),
        write(1012, 1), write(1100, 1), write(1101, 1), write(1100, *range(9)), write(65535, 1),
        struct.pack(">BHH", 6, 1008, 1), struct.pack(">BHH", 6, 1100, 1),
    ],
)  # fmt: skip
def test_what_may_not_be_written_is_an_illegal_address(body: bytes) -> None:
    bench = Bench()
    before = bench.ask(read(3, 1000, 10)), bench.ask(read(3, 1100, 8))
    assert bench.ask(body) == bytes([body[0] | 0x80, 2])
    assert (bench.ask(read(3, 1000, 10)), bench.ask(read(3, 1100, 8))) == before


@pytest.mark.parametrize(
    "body",
    [
        struct.pack(">BHHB", 16, 1000, 0, 0), struct.pack(">BHHBH", 16, 1000, 1, 4, 1),
        struct.pack(">BHHBH", 16, 1000, 2, 4, 1), struct.pack(">BHHBHH", 16, 1000, 1, 2, 1, 1),
        struct.pack(">BHHB", 16, 1000, 124, 248) + bytes(246), struct.pack(">BHHBHB", 16, 1000, 1, 2, 1, 0),
    ],
)  # fmt: skip
def test_counts_and_bytes_that_disagree_write_nothing(body: bytes) -> None:
    bench = Bench()
    assert bench.ask(body) == b"\x90\x03"
    assert bench.ask(read(3, 1000, 8)) == b"\x03\x10" + bytes(16)


def odometry(number: int, age: int = 0) -> bytes:
    return write(1100, number, age, 0, 10_000, 0xFFFF, 0xD8F0, 0, 500)


def test_odometry_is_taken_once_per_number() -> None:
    bench = Bench()
    for number in (7, 7, 8):
        assert bench.ask(odometry(number, age=200))[0] == 16
    assert [(o.x, o.y, o.yaw, o.age) for o in bench.odometry] == [(1.0, -1.0, 0.0005, 0.02)] * 2
    assert [o.restarted for o in bench.odometry] == [True, False]


def test_number_zero_says_that_odometry_begins_anew() -> None:
    bench = Bench()
    for number in (7, 8, 0, 1):
        bench.ask(odometry(number))
    assert [o.restarted for o in bench.odometry] == [True, False, True, False]


def test_an_age_that_is_not_known_is_none_and_a_wild_one_is_cut() -> None:
    bench = Bench()
    bench.ask(odometry(1, age=0xFFFF))
    bench.ask(odometry(2, age=60_000))
    assert [o.age for o in bench.odometry] == [0.0, 1.0]


def test_odometry_that_is_not_known_is_not_taken() -> None:
    bench = Bench()
    bench.ask(write(1100, 1, 0, 0x8000, 0, 0, 0, 0, 0))
    assert bench.odometry == []


def test_the_first_request_is_1_and_0_is_one_after_the_numbers_have_wrapped() -> None:
    commands: list[Request] = []
    holding = Holding(commands.append, lambda reading: None)
    for number, asked in ((0, []), (1, [1]), (65535, [1, 65535]), (0, [1, 65535, 0])):
        holding.write(1000, struct.pack(">HH", number, CommandCode.RELOCALISE))
        assert [one.number for one in commands] == asked
        if asked:
            assert struct.unpack(">HH", holding.read(1008, 2))[1] == Outcome.RUNNING
            holding.acknowledge(number, Outcome.DONE)
            assert struct.unpack(">HH", holding.read(1008, 2)) == (number, Outcome.DONE)
        else:
            assert struct.unpack(">HH", holding.read(1008, 2)) == (0, Outcome.NONE)
    assert "Begin with 1" in next(point.text for point in COMMAND.points if point.name == "request")


def read_write(address: int, count: int, to: int, *words: int) -> bytes:
    return struct.pack(f">BHHHHB{len(words)}H", 23, address, count, to, len(words), 2 * len(words), *words)


def test_a_write_that_reads_too_writes_first() -> None:
    bench = Bench()
    asked = [7, CommandCode.SAVE_MAP, *[0] * 6]
    answer = bench.ask(read_write(1000, 10, 1000, *asked))
    assert answer[:2] == b"\x17\x14"
    assert struct.unpack(">10H", answer[2:]) == (*asked, 0, Outcome.RUNNING)
    assert [(one.number, one.code) for one in bench.commands] == [(7, CommandCode.SAVE_MAP)]
    assert bench.ask(read_write(0, 64, 1050, 5)) == bytes([23, 128]) + bench.block
    assert bench.loops == [5]


@pytest.mark.parametrize(
    ("body", "exception"),
    [
        (read_write(63, 2, 1050, 5), 2),  # what is to be read is not there: nothing is written
        (read_write(0, 64, 1051, 5), 2),
        (read_write(0, 0, 1050, 5), 3),
        (read_write(0, 126, 1050, 5), 3),
        (read_write(0, 4, 1050), 3),
        (read_write(0, 4, 1050, 5) + b"\0", 3),
        (read_write(0, 4, 1050, 5)[:-1], 3),
        (b"\x17", 3),
    ],
)
def test_a_write_that_reads_too_is_carried_out_as_a_whole_or_not(body: bytes, exception: int) -> None:
    bench = Bench()
    assert bench.ask(body) == bytes([0x97, exception])
    assert (bench.loops, bench.commands) == ([], [])


def test_the_largest_write_that_reads_too_is_that_of_the_standard() -> None:
    asked = [bytes([0x97, 2]), bytes([0x97, 3])]  # 121 registers are a write to what is not there
    assert [Bench().responder.answer_body(read_write(0, 4, 1000, *[0] * count)) for count in (121, 122)] == asked


def test_without_writing_there_is_no_function_that_writes() -> None:
    assert Bench(write=False).ask(read_write(0, 4, 1050, 5)) == b"\x97\x01"


def objects_in(answer: bytes) -> dict[int, bytes]:
    """Objects of a reply to function 43, MEI type 14, with its head checked."""
    head, count, rest = answer[:7], answer[6], answer[7:]
    assert (head[:2], head[3:6]) == (b"\x2b\x0e", b"\x82\x00\x00"), "regular objects, nothing follows"
    found: dict[int, bytes] = {}
    while rest:
        found[rest[0]], rest = rest[2 : 2 + rest[1]], rest[2 + rest[1] :]
    assert len(found) == count
    return found


@pytest.mark.parametrize(
    ("access", "first", "found"),
    [(1, 0, [0, 1, 2]), (2, 0, range(7)), (3, 0, range(7)), (2, 4, [4, 5, 6]), (1, 4, [0, 1, 2]), (3, 0x80, range(7)),
     (4, 6, [6]), (4, 2, [2])],
)  # fmt: skip
def test_the_device_is_identified(access: int, first: int, found: list[int]) -> None:
    told = objects_in(Bench().ask(bytes([43, 14, access, first])))
    assert list(told) == list(found)
    assert all(text and text.isascii() for text in told.values())


def test_the_names_in_the_identification() -> None:
    responder = Responder(name="agv-11")
    told = objects_in(responder.answer_body(bytes([43, 14, 3, 0])))
    assert (told[1], told[2], told[6]) == (b"lumiloop", release().encode(), b"agv-11")


@pytest.mark.parametrize(
    ("body", "exception"),
    [
        (bytes([43, 14, 4, 7]), 2),
        (bytes([43, 14, 0, 0]), 3),
        (bytes([43, 14, 5, 0]), 3),
        (bytes([43, 14, 1]), 3),
        (bytes([43, 14, 1, 0, 0]), 3),
        (bytes([43]), 3),
        (bytes([43, 13, 1, 0]), 1),  # CANopen
    ],
)
def test_what_is_no_question_for_the_identification(body: bytes, exception: int) -> None:
    assert Bench().ask(body) == bytes([0xAB, exception])
