"""The support archive: only own files, bounded, no links followed, and missing parts listed."""

from __future__ import annotations

import json
import os
import tarfile
import zipfile

import pytest

from ahrsd.daemon.support_bundle import FORMATS, collect, write_bundle
from ahrsd.errors import AhrsdError


@pytest.fixture
def state(tmp_path):
    folder = tmp_path / "state"
    (folder / "captures").mkdir(parents=True)
    (folder / "journal-1.jsonl").write_text("one\n")
    for k, name in enumerate(("ahrsd-old.mcap", "ahrsd-new.mcap")):
        (folder / "captures" / name).write_text(name)
        os.utime(folder / "captures" / name, (k, k))
    return folder


def bundle_of(state, status=None):
    return collect(state, state / "captures", 'mode = "observe"\n', status)


def test_archive_has_journal_newest_capture_status_and_configuration(state):
    found = bundle_of(state, {"schema": "ahrsd.status/1"})
    assert found.parts["journal/journal-1.jsonl"] == b"one\n"
    assert found.parts["captures/ahrsd-new.mcap"] == b"ahrsd-new.mcap"
    assert json.loads(found.parts["status.json"]) == {"schema": "ahrsd.status/1"}
    assert found.parts["config.toml"] == b'mode = "observe"\n'
    assert found.left_out == [f"1 older captures in {state / 'captures'}"]
    assert found.parts["left-out.txt"].decode() == found.left_out[0] + "\n"


def test_links_fifos_devices_and_folders_are_left_out_and_listed(state, tmp_path):
    (tmp_path / "secret").write_text("a key")
    (state / "journal-2.jsonl").symlink_to(tmp_path / "secret")
    os.mkfifo(state / "journal-3.jsonl")
    (state / "journal-4.jsonl").mkdir()
    (state / "captures" / "ahrsd-z.mcap").symlink_to("/dev/zero")
    found = bundle_of(state)
    assert set(found.parts) == {
        "versions.json", "config.toml", "left-out.txt", "journal/journal-1.jsonl",
        "captures/ahrsd-new.mcap",
    }  # fmt: skip
    assert found.left_out[:4] == [
        f"{state / 'journal-2.jsonl'}: is a symbolic link",
        f"{state / 'journal-3.jsonl'}: is a FIFO",
        f"{state / 'journal-4.jsonl'}: is a folder",
        f"{state / 'captures' / 'ahrsd-z.mcap'}: is a symbolic link",
    ]
    assert b"a key" not in b"".join(found.parts.values())


def test_archive_is_bounded(state, monkeypatch):
    monkeypatch.setattr("ahrsd.daemon.support_bundle._CAPTURE_BYTES", 4)
    monkeypatch.setattr("ahrsd.daemon.support_bundle._JOURNAL_BYTES", 2)
    monkeypatch.setattr("ahrsd.daemon.support_bundle._MOST_JOURNALS", 1)
    (state / "journal-0.jsonl").write_text("older\n")
    os.utime(state / "journal-0.jsonl", (1, 1))
    found = bundle_of(state)
    assert found.parts["journal/journal-1.jsonl"] == b"e\n"  # its newest part
    assert found.parts["captures/ahrsd-new.mcap"] == b"ahrs"  # its first part
    assert found.left_out == [
        f"{state / 'journal-1.jsonl'}: its first 2 bytes",
        "1 older journals",
        f"{state / 'captures' / 'ahrsd-new.mcap'}: its last 10 bytes",
        f"1 older captures in {state / 'captures'}",
    ]


def test_archive_is_made_without_any_folder(tmp_path):
    found = collect(tmp_path / "no", tmp_path / "no" / "captures", "", None)
    assert set(found.parts) == {"versions.json", "config.toml"}


@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize("umask", [0o000, 0o077])
def test_archive_format_follows_the_name_and_only_the_owner_may_read_it(
    state, tmp_path, ending, umask
):
    file = tmp_path / f"x{ending}"
    (tmp_path / "victim").write_text("mine")
    file.symlink_to(tmp_path / "victim")
    before = os.umask(umask)
    try:
        write_bundle(file, bundle_of(state))
    finally:
        os.umask(before)
    assert not file.is_symlink()
    assert file.stat().st_mode & 0o777 == 0o600
    assert (tmp_path / "victim").read_text() == "mine"
    if ending == ".zip":
        with zipfile.ZipFile(file) as archive:
            body = archive.read("ahrsd-bundle/journal/journal-1.jsonl")
    else:
        with tarfile.open(file) as archive:
            body = archive.extractfile("ahrsd-bundle/journal/journal-1.jsonl").read()
    assert body == b"one\n"


def test_unknown_archive_format_is_refused(state, tmp_path):
    with pytest.raises(AhrsdError, match=r"must end in .tar.gz, .tgz, .tar, .zip"):
        write_bundle(tmp_path / "x.rar", bundle_of(state))
    assert not (tmp_path / "x.rar").exists()


def test_command_lists_what_it_left_out(run, state, tmp_path, capsys):
    os.mkfifo(state / "journal-3\x1b.jsonl")
    config = tmp_path / "a.toml"
    config.write_text(f'state_directory = "{state}"\n')
    assert run("bundle", "--config", config, "-o", tmp_path / "x.tar.gz") == 0
    said = capsys.readouterr()
    assert "no daemon" in said.err or "archive is made without its status" in said.err
    assert r"journal-3\x1b.jsonl: is a FIFO" in said.out
    assert "\x1b" not in said.out
