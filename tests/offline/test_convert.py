"""Output of `ahrsd convert --list` for the project's own recordings."""

from __future__ import annotations

import numpy as np
from click.testing import CliRunner

from ahrsd.cli import LazyGroup
from ahrsd.recording.table import write_table
from drivers.vn100.messages import MESSAGES, encode_sentence


def listed(path) -> list[str]:
    result = CliRunner().invoke(LazyGroup("ahrsd"), ["convert", str(path), "--list"])
    assert result.exit_code == 0, result.output
    return result.output.splitlines()


def test_list_of_a_byte_stream_has_its_messages_and_the_other_bytes(tmp_path):
    line = encode_sentence("VNMAR", (0.1, 0.2, 0.3, 0.0, 0.0, -9.8, 0.01, 0.02, 0.03))
    packets = bytes.fromhex("fa010800")  # cut off: no message
    (tmp_path / "raw").write_bytes(7 * line + b"$VNWRG,06,14*59\r\n" + 5 * line + packets)
    first, second, third, left = listed(tmp_path / "raw")
    assert first == "raw is a byte stream"
    columns = ", ".join(column.name for column in MESSAGES["VNMAR"].columns)
    assert second == f"VNMAR  12 messages  {columns}"
    assert third == "VNWRG, a reply  1 message"
    assert left == f"4 of {12 * len(line) + 17 + 4:,} bytes belong to no whole message"


def test_list_of_a_table_has_acceleration_only_if_present(tmp_path):

    rows = np.arange(40.0)
    columns = {"time_s": rows / 20}
    columns |= {f"mag_{axis}_gauss": 0.2 + 0.01 * rows for axis in "xyz"}
    columns |= {f"gyro_{axis}_rad_s": 0.1 + 0 * rows for axis in "xyz"}
    write_table(tmp_path / "without.parquet", columns)
    columns |= {f"accel_{axis}_m_s2": 1 + 0 * rows for axis in "xyz"}
    write_table(tmp_path / "with.parquet", columns)
    assert not [line for line in listed(tmp_path / "without.parquet") if "accel" in line]
    assert "column accel_z_m_s2" in listed(tmp_path / "with.parquet")
