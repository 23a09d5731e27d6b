"""The layout of registers and datagrams is the frozen one, or of a newer version."""

import json
from pathlib import Path
from typing import Any

from daemon.publish.modbus import registers
from daemon.snapshot import State

FROZEN = Path(__file__).parent / "frozen"


def layout() -> dict[str, Any]:
    """The contract as data: what must not change under one version number."""
    body = [
        {
            "name": p.name, "register": registers.BODY_ADDRESS + offset, "byte": registers.BODY_OFFSET + 2 * offset,
            "type": p.wire.name, "per_unit": p.per_unit, "unit": p.unit, "rule": p.rule.value,
            "not_known": p.wire.not_known if p.can_be_unknown else None,
        }
        for offset, p in zip(registers.BODY.offsets, registers.BODY.points, strict=True)
    ]  # fmt: skip
    return {
        "version": registers.VERSION,
        "registers": registers.BLOCK_WORDS,
        "datagram_bytes": registers.DATAGRAM_SIZE,
        "mirror_address": registers.MIRROR_ADDRESS,
        "body": body,
        "mirror": [{"name": p.name, "unit": p.unit} for p in registers.MIRROR],
        "flags": [name for name, _, _ in registers.FLAGS],
        "devices": [name for name, _, _ in registers.DEVICES],
        "states": {state.name: state.value for state in State},
    }


def test_the_contract_is_the_frozen_one() -> None:
    """A published layout is never edited: bits and states may be appended, anything else needs a new version."""
    path = FROZEN / f"layout_v{registers.VERSION}.json"
    assert path.exists(), f"version {registers.VERSION} has no frozen copy: write layout() to {path.name}"
    frozen, now = json.loads(path.read_text()), layout()
    assert now.pop("datagram_bytes") >= frozen.pop("datagram_bytes"), "a datagram may grow at its end"
    for key in ("flags", "devices"):
        assert now.pop(key)[: len(frozen[key])] == frozen.pop(key), key
    states = frozen.pop("states")
    assert {name: now["states"].get(name) for name in states} == states
    now.pop("states")
    assert now == frozen


def test_versions_only_count_up() -> None:
    versions = sorted(int(path.stem.removeprefix("layout_v")) for path in FROZEN.glob("layout_v*.json"))
    assert versions == list(range(1, registers.VERSION + 1)), "every published version keeps its frozen copy"
