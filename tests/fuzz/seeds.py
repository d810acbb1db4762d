"""Makes the first inputs of each target's corpus, from what the project itself produces.

python tests/fuzz/seeds.py writes fixtures/fuzz/TARGET/seed-*; inputs that a fuzzer found are kept
beside them under the names that it gave.
"""

from __future__ import annotations

import gzip
import json
import sys
import tempfile
from pathlib import Path

from ahrsd.config.config import Config, print_config
from ahrsd.daemon.journal import Journal
from ahrsd.inputs import Received, Stop, Tick
from ahrsd.recording.capture import CaptureWriter

PROJECT = Path(__file__).parents[2]
CORPUS = PROJECT / "fixtures" / "fuzz"
_LENGTH = 3000


def streams() -> list[bytes]:
    """Pieces of the fixtures' streams: text, binary, both, and damage."""
    found = []
    for path in sorted((PROJECT / "fixtures" / "replays").glob("*.gz")):
        data = gzip.decompress(path.read_bytes())
        found += [data[:_LENGTH], data[len(data) // 2 : len(data) // 2 + _LENGTH]]
    return found


def vectors() -> list[bytes]:
    """Replies and odd messages of the protocol's vectors that the project keeps."""
    found = []
    for path in sorted((PROJECT / "fixtures" / "vn100").rglob("*")):
        if path.is_file():
            found.append(path.read_bytes()[:_LENGTH])
    return found


def captures() -> list[bytes]:
    """A capture, whole and cut."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c.mcap"
        with CaptureWriter(path, {"program": "fuzz"}) as writer:
            for number, data in enumerate(streams()[:2]):
                writer.write(Received(number * 10**9, data))
                writer.write(Tick(number * 10**9 + 5))
            writer.write(Stop(3 * 10**9, "end"))
        whole = path.read_bytes()
    return [whole, whole[: len(whole) * 2 // 3]]


def journals() -> list[bytes]:
    """A journal with a whole transaction, and one with a torn end."""
    registers = {"23": [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, 0.0, 0.0, 0.0]}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "journal-1.jsonl"
        book = Journal.open(path, utc=lambda: "2026-11-03T00:00:00.000+00:00")
        book.append("PREPARED", txn="t1", serial=1, old=registers, new=registers, wall_s=1.0)
        for kind in ("RAM_VERIFIED", "PROVEN", "FLASH_SENT", "FLASH_ACKED", "CONFIRMED"):
            book.append(kind, txn="t1", wall_s=2.0)
        book.append("LOCKED", reason="a person", wall_s=3.0)
        whole = path.read_bytes()
    return [whole, whole[:-20]]


def requests() -> list[bytes]:
    """What clients say."""
    asks = [{"ask": "status"}, {"ask": "explain"}, {"ask": "watch", "of": ["samples", "events"]}]
    return [b"\n".join(json.dumps(ask).encode() for ask in asks), b'{"ask": 1}', b"[[[[[["]


def main() -> None:
    """Write every seed."""
    configs = [print_config(Config()).encode(), b'mode = "stage"\n[device]\nserial_number = 7\n']
    seeds = {
        "deframer": streams() + vectors(),
        "messages": streams() + vectors(),
        "pipeline": streams(),
        "config": configs,
        "capture": captures(),
        "journal": journals(),
        "socket_line": requests(),
        "columns": [b'{"motor_current_a": 3.2, "rudder_deg": -4}', b'{"a": [1e999]}', b"[" * 4000],
    }
    for target, inputs in seeds.items():
        folder = CORPUS / target
        folder.mkdir(parents=True, exist_ok=True)
        for number, data in enumerate(inputs):
            (folder / f"seed-{number:02d}").write_bytes(data)
    sys.stderr.write(f"{CORPUS}: {sum(map(len, seeds.values()))} seeds\n")


if __name__ == "__main__":
    main()
