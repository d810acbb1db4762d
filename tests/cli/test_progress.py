"""Progress: every kind of recording adds up to the file, and a bar moves on a terminal."""

from __future__ import annotations

import gzip
import io
import sys

import pytest

from ahrsd.cli.long_work import byte_progress, count_progress
from ahrsd.config.config import Config
from ahrsd.offline.replay import replay


@pytest.fixture(scope="module")
def streams(tmp_path_factory):
    """A byte stream plain and packed, and a table plain and packed, of one simulation."""
    from ahrsd.__main__ import main

    folder = tmp_path_factory.mktemp("recordings")
    for name in ("a.vnraw", "a.vnraw.gz", "a.csv", "a.csv.gz"):
        with pytest.raises(SystemExit):
            main(["simulate", "wam", "--seconds", "60", "-o", str(folder / name)])
    return folder


@pytest.mark.parametrize("name", ["a.vnraw", "a.vnraw.gz", "a.csv", "a.csv.gz"])
def test_progress_adds_up_to_the_file_size(streams, name):
    told: list[int] = []
    path = streams / name
    replay(path, Config(), rate_hz=25.0 if "raw" in name else None, progress=told.append)
    assert sum(count > 0 for count in told) >= 2
    assert sum(told) == pytest.approx(path.stat().st_size, rel=0.02)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_bar_shows_how_much_of_the_file_is_done(tmp_path, monkeypatch):
    path = tmp_path / "a[bold].csv.gz"
    path.write_bytes(gzip.compress(b"x" * 100_000) + b"0" * 1000)
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("TERM", "xterm")
    with byte_progress(path) as done:
        done(path.stat().st_size // 2)
    text = sys.stderr.getvalue()
    assert "a[bold].csv.gz" in text
    whole = path.stat().st_size / 1e3
    assert f"{whole / 2:.1f}/{whole:.1f} kB" in text


def test_no_progress_bar_without_a_terminal(tmp_path):
    with byte_progress(tmp_path / "a.csv") as done, count_progress("cases") as counted:
        assert done is None
        assert counted is None
