"""A SCIP sensor's side of the wire in thirty lines, written for tests from the specification alone.

It shares nothing with the driver's codec or with the fake sensor, so that none can hide another's error.
"""

from collections.abc import Iterable, Sequence


def number(value: int, chars: int) -> str:
    """Six bits a character, most significant first, 0 is "0"."""
    text = ""
    for _ in range(chars):
        text = chr(48 + value % 64) + text
        value //= 64
    assert value == 0
    return text


def sum_char(text: str) -> str:
    return chr(sum(map(ord, text)) % 64 + 48)


def lines(payload: str) -> str:
    """Payload cut into lines of 64 characters, each with its sum."""
    parts = [payload[i : i + 64] for i in range(0, len(payload), 64)]
    return "".join(part + sum_char(part) + "\n" for part in parts)


def answer(echo: str, status: str, body: str = "") -> bytes:
    return f"{echo}\n{status}{sum_char(status)}\n{body}\n".encode("ascii")


def scan(echo: str, stamp: int, payload: str, status: str = "99") -> bytes:
    return answer(echo, status, lines(number(stamp, 4)) + lines(payload))


def text(echo: str, pairs: Iterable[tuple[str, str]]) -> bytes:
    """VV, PP, II: the semicolon is not summed."""
    body = "".join(f"{key}:{value};{sum_char(f'{key}:{value}')}\n" for key, value in pairs)
    return answer(echo, "00", body)


def payload(steps: Sequence[Sequence[tuple[int, ...]]], chars: int = 3) -> str:
    """Steps of echoes of (distance,) or (distance, intensity)."""
    return "".join("&".join("".join(number(v, chars) for v in echo) for echo in step) for step in steps)


PP_UTM = [("MODL", "UTM-30LX"), ("DMIN", "23"), ("DMAX", "60000"), ("ARES", "1440"), ("AMIN", "0")]
PP_UTM += [("AMAX", "1080"), ("AFRT", "540"), ("SCAN", "2400")]
VV_UTM = [("VEND", "Hokuyo Automatic Co.,Ltd."), ("PROD", "SOKUIKI Sensor TOP-URG UTM-30LX")]
VV_UTM += [("FIRM", "P.1.05(17/Apr./2009)"), ("PROT", "SCIP 2.0"), ("SERI", "H0900001")]
