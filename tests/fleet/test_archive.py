"""Which files of an archive are recordings, on a disk and through fsspec."""

from __future__ import annotations

import os
import sys
from types import SimpleNamespace

import pytest

from ahrsd.errors import AhrsdError
from ahrsd.fleet.archive import Archive, ArchiveEntry, local_file, pieces

FILES = ("rov1/harbour/a.mcap", "rov1/b.csv.gz", "c.ULG", "rov2/d.vnraw")
OTHERS = ("readme.md", "rov1/b.csv.gz.truth.json", "rov1/b.gps.csv.gz", "rov2/.hidden.csv")


@pytest.fixture
def archive(tmp_path):
    for name in (*FILES, *OTHERS):
        path = tmp_path / "archive" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return tmp_path / "archive"


def names(entries, root):
    return sorted(entry.url.removeprefix(f"{root}/") for entry in entries)


def test_recordings_are_recognised_by_name_and_other_files_are_counted(archive):
    left_out = []
    entries = list(Archive(str(archive)).entries(left_out.append))
    assert names(entries, archive) == sorted(FILES)
    assert sorted(left_out) == ["b.csv.gz.truth.json", "b.gps.csv.gz", "readme.md"]
    folders = {entry.url.rpartition("/")[2]: entry.folders for entry in entries}
    assert folders["a.mcap"] == ("rov1", "harbour")
    assert folders["c.ULG"] == ()


def test_patterns_replace_the_suffixes(archive):
    entries = Archive(str(archive), ("*.md", "a.*")).entries()
    assert names(entries, archive) == ["readme.md", "rov1/harbour/a.mcap"]


def test_ros_2_folder_is_one_recording(archive):
    bag = archive / "rov3" / "bag"
    bag.mkdir(parents=True)
    (bag / "metadata.yaml").write_text("x")
    (bag / "bag_0.db3").write_bytes(b"12345")
    found = {entry.url: entry for entry in Archive(str(archive)).entries()}
    assert f"{bag}/bag_0.db3" not in found
    assert found[str(bag)].size_bytes == 6
    assert found[str(bag)].folders == ("rov3",)


@pytest.mark.parametrize("what", ["a dangling link", "a link to itself", "a file of a subfolder"])
def test_ros_2_folder_is_listed_whatever_is_in_it(archive, what):
    bag = archive / "rov3" / "bag"
    (bag / "parts").mkdir(parents=True)
    (bag / "metadata.yaml").write_text("x")
    if what == "a file of a subfolder":
        (bag / "parts" / "bag_0.db3").write_bytes(b"12345")
    else:
        (bag / "bag_0.db3").symlink_to("nowhere" if what == "a dangling link" else "bag_0.db3")
    found = {entry.url: entry for entry in Archive(str(archive)).entries()}
    assert found[str(bag)].is_folder
    if what == "a file of a subfolder":
        assert found[str(bag)].size_bytes == 6
        assert b"".join(pieces(bag)) == b"metadata.yaml\0xparts/bag_0.db3\x0012345"
    else:
        with pytest.raises(OSError, match=r"No such file|Too many levels"):
            list(pieces(bag))


def test_link_to_itself_is_an_entry_and_linked_folders_are_reported(archive):
    (archive / "loop.csv").symlink_to("loop.csv")
    (archive / "round").symlink_to("round")
    (archive / "rov9").symlink_to(archive / "rov1")
    left_out, linked = [], []
    entries = list(Archive(str(archive)).entries(left_out.append, linked.append))
    assert names(entries, archive) == sorted([*FILES, "loop.csv"])
    assert "round" in left_out
    assert linked == [str(archive / "rov9")]


def test_what_is_no_regular_file_is_not_opened(archive):
    os.mkfifo(archive / "pipe.csv")
    (archive / "zero.csv").symlink_to("/dev/zero")
    for name, kind in (("pipe.csv", "a FIFO"), ("zero.csv", "a device")):
        with pytest.raises(OSError, match=f"is {kind}, not a regular file"):
            next(pieces(archive / name))


def test_fsspec_lists_and_reads_the_same_files(archive):
    pytest.importorskip("fsspec", reason="fsspec (the extra fleet) is not installed")
    root = f"file://{archive}"
    entries = list(Archive(root).entries())
    assert names(entries, root) == sorted(FILES)
    one = next(entry for entry in entries if entry.url.endswith("a.mcap"))
    assert one.folders == ("rov1", "harbour")
    assert one.size_bytes == len(FILES[0])
    with local_file(one) as path:
        assert path != archive / FILES[0]
        assert path.name == "a.mcap"
        assert path.read_bytes() == FILES[0].encode()
    assert not path.exists()


@pytest.mark.parametrize(
    ("root", "words"),
    [
        ("{}/none", "does not exist; give the folder"),
        ("{}/c.ULG", "is no folder"),
        ("file://{}/none", "holds no folder of that name"),
        ("nobody://x", "Protocol not known"),
        ("s3://bucket/dives", "pip install 'ahrsd[s3]'"),
    ],
)
def test_archive_that_cannot_be_listed_is_refused(archive, root, words):
    if root.startswith("s3"):
        try:
            import s3fs  # noqa: F401
        except ImportError:
            pass
        else:
            pytest.skip("s3fs is installed")
    with pytest.raises(AhrsdError) as told:
        list(Archive(root.format(archive)).entries())
    assert words in str(told.value)


def test_storage_error_is_reported_in_one_line(monkeypatch):
    """Storage libraries raise classes of their own, such as those of botocore."""
    fsspec = pytest.importorskip("fsspec", reason="fsspec (the extra fleet) is not installed")

    class BotoCoreError(Exception):
        pass

    class NoEndpoint(BotoCoreError):
        pass

    library = SimpleNamespace(BotoCoreError=BotoCoreError, ClientError=BotoCoreError)
    monkeypatch.setitem(sys.modules, "botocore.exceptions", library)

    class Failing(fsspec.AbstractFileSystem):
        protocol = "failing"

        def isdir(self, path):
            raise NoEndpoint("could not connect to the endpoint\nhttp://store")

        def get_file(self, rpath, lpath, **_):
            raise NoEndpoint("connection reset")

    fsspec.register_implementation("failing", Failing, clobber=True)
    with pytest.raises(AhrsdError) as told:
        list(Archive("failing://dives").entries())
    (line,) = str(told.value).splitlines()
    assert line.startswith("failing://dives: cannot be listed: NoEndpoint: could not connect")
    assert line.endswith("check the address, the network and the credentials")
    entry = ArchiveEntry("failing://dives/a.mcap", 1, "", ())
    with pytest.raises(OSError, match="NoEndpoint: connection reset"), local_file(entry):
        pass
