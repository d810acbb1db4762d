"""The command line: help without heavy imports, one line per error, exit codes, log lines."""

from __future__ import annotations

import io
import logging
import os
import subprocess
import sys
from pathlib import Path

import click
import pytest

from ahrsd import __main__ as program
from ahrsd import __version__
from ahrsd.cli import COMMANDS
from ahrsd.config.config import Config, load_config
from ahrsd.daemon import logs
from ahrsd.errors import EXIT_USAGE, ConfigError, DeviceError, JournalError, RecordingError


@pytest.fixture
def failing(monkeypatch):
    """A command `ahrsd demo` that raises what it is given."""

    def install(error: BaseException) -> None:
        @click.command()
        def command() -> None:
            raise error

        monkeypatch.setattr(program.group, "get_command", lambda *_: command)

    return install


def test_help_lists_every_command_and_imports_nothing_heavy():
    code = (
        "import sys\n"
        "from ahrsd.__main__ import main\n"
        "try:\n    main(['--help'])\n"
        "except SystemExit as end:\n    assert not end.code\n"
        "heavy = {'numpy', 'scipy', 'gtsam', 'rerun', 'serial', 'pydantic', 'mcap', 'pyarrow'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for name in COMMANDS:
        assert f"\n  {name} " in done.stdout


@pytest.mark.parametrize("words", [[], ["make", "--cases", "3", "-o", "new"], ["score", "x"]])
def test_blind_trials_without_the_source_tree_name_what_to_install(words):
    code = (
        "import sys\n"
        "sys.path = [path for path in sys.path if not path.endswith('tests/tools')]\n"
        "from ahrsd.__main__ import main\n"
        f"main(['challenge', *{words}])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "ahrsd: the blind trials are not in this installation: they are a tool of the source tree; "
        "clone it and install the clone with: pip install -e '.[trials]'\n"
    )


@pytest.mark.parametrize(("given", "used"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_blas_uses_one_thread_by_default(given, used):
    code = (
        "import ahrsd.__main__, os, sys\n"
        "assert 'numpy' not in sys.modules\n"
        "print(os.environ['OPENBLAS_NUM_THREADS'])\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"} | given
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == f"{used}\n"


def test_version(run, capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out == f"ahrsd, version {__version__}\n"


@pytest.mark.parametrize("name", ["capture", "registers", "run"])
def test_every_command_has_help(run, name, capsys):
    assert run(name, "--help") == 0
    assert f"Usage: ahrsd {name}" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["read", "diff", "write", "history", "rollback"])
def test_every_register_command_has_help(run, name, capsys):
    assert run("registers", name, "--help") == 0
    assert f"Usage: ahrsd registers {name}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (RecordingError("a.csv", "is empty", "record again"), 2, "a.csv: is empty; record again"),
        (JournalError("the journal is damaged"), 1, "the journal is damaged"),
        (DeviceError("refused"), 1, "refused"),
        (DeviceError("/dev/x is in use by 12 gpsd", 75), 75, "/dev/x is in use by 12 gpsd"),
    ],
)
def test_an_expected_error_is_one_line_and_its_exit_code(run, failing, capsys, error, code, line):
    failing(error)
    assert run("demo") == code
    assert capsys.readouterr().err == f"ahrsd: {line}\n"


def test_each_wrong_key_of_a_configuration_is_a_line(run, failing, capsys):
    failing(ConfigError(["a.toml: mode = 1: x", "a.toml: port = 2: y"]))
    assert run("demo") == 2
    assert capsys.readouterr().err == "ahrsd: a.toml: mode = 1: x\nahrsd: a.toml: port = 2: y\n"


def test_a_bug_is_70_with_its_traceback(run, failing, capsys):
    failing(ZeroDivisionError("planted"))
    assert run("demo") == 70
    error = capsys.readouterr().err
    assert "ZeroDivisionError: planted" in error
    assert "internal error (ZeroDivisionError), this is a bug" in error


def test_an_interrupt_is_130(run, failing, capsys):
    failing(KeyboardInterrupt())
    assert run("demo") == 130
    assert capsys.readouterr().err.strip() == "ahrsd: interrupted"


def test_an_exit_code_of_a_command_is_the_programs(run, failing):
    failing(SystemExit(1))
    assert run("demo") == 1


def test_wrong_usage_is_2(run, capsys):
    assert run("frobnicate") == 2
    assert "No such command 'frobnicate'" in capsys.readouterr().err
    assert run("capture") == 2
    assert "Missing argument 'PORT'" in capsys.readouterr().err


def test_closed_output_pipe_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-m", "ahrsd", "run", "--print-config"],
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


def test_full_disk_behind_stdout_is_one_line_and_no_bug():
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "ahrsd", "run", "--print-config"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr == "ahrsd: cannot write: No space left on device; make room for it\n"


class TestRun:
    """Options of `run` that need no device."""

    def test_printed_configuration_reloads_to_the_one_in_force(self, run, tmp_path, capsys):
        (tmp_path / "a.toml").write_text("[gates]\nclosure_deg = 4.0\n")
        assert run("run", "--config", str(tmp_path / "a.toml"), "--port", "/dev/vn100",
                   "--mode", "stage", "--print-config") == 0  # fmt: skip
        (tmp_path / "b.toml").write_text(capsys.readouterr().out)
        config = load_config(tmp_path / "b.toml")
        assert (config.mode, str(config.device.port)) == ("stage", "/dev/vn100")
        assert config.gates.closure_deg == 4.0
        assert config.budget == Config().budget

    def test_a_wrong_configuration_is_2_and_one_line(self, run, tmp_path, capsys):
        (tmp_path / "a.toml").write_text('moed = "stage"\n')
        assert run("run", "--config", str(tmp_path / "a.toml")) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert "did you mean mode?" in error

    def test_without_a_port(self, run, capsys):
        assert run("run") == 2
        assert "no port: give --port" in capsys.readouterr().err

    def test_missing_port_is_code_75_and_one_line(self, run, tmp_path, capsys):
        (tmp_path / "a.toml").write_text(f'state_directory = "{tmp_path}"')
        port = "/dev/does-not-exist"
        assert run("run", "--config", tmp_path / "a.toml", "--port", port) == 75
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert "/dev/does-not-exist does not exist" in error

    def test_an_unknown_mode(self, run, capsys):
        assert run("run", "--mode", "write") == 2
        assert "'passive', 'observe', 'stage', 'commit'" in capsys.readouterr().err


class TestLogs:
    """Log lines are a sentence and facts."""

    def line(self, journald: bool, **facts: object) -> str:
        record = logging.LogRecord(
            "ahrsd.daemon", logging.WARNING, "f", 1, "port %s", ("open",), None
        )
        record.created, record.msecs = 0.25, 250.0
        vars(record).update(logs.facts(**facts))
        return logs.FactsFormatter(journald).format(record)

    def test_facts_are_keys_and_values(self):
        line = self.line(False, baud=115200, rate_hz=0.1 + 0.2, why="two words", empty="")
        assert line[12:] == (
            " WARNING daemon: port open baud=115200 rate_hz=0.3 why='two words' empty=''"
        )
        assert line[8:12] == ".250"

    def test_journald_gets_the_priority_and_no_time(self):
        assert self.line(True, baud=1) == "<4>daemon: port open baud=1"

    @pytest.mark.parametrize("journald", [False, True])
    def test_no_text_of_others_begins_a_line_or_moves_the_cursor(self, journald):
        record = logging.LogRecord(
            "ahrsd", logging.INFO, "f", 1, "operator: lock %s",
            ("x\n<2>ahrsd: all is well\r\x1b[2J\x9b1A\u202eyes",), None,
        )  # fmt: skip
        vars(record).update(logs.facts(name="a\n<7>b"))
        line = logs.FactsFormatter(journald).format(record)
        assert "\n" not in line
        assert line.isprintable()
        assert r"lock x\n<2>ahrsd: all is well\r\x1b[2J\x9b1A\u202eyes name='a\n<7>b'" in line

    def test_each_line_of_a_traceback_has_the_priority(self):
        record = logging.LogRecord("ahrsd", logging.ERROR, "f", 1, "it broke off", (), None)
        record.trace = "Traceback\n  File x\nValueError: a\x1b\n"
        lines = logs.FactsFormatter(True).format(record).split("\n")
        assert lines == [
            "<3>ahrsd: it broke off",
            "<3>Traceback",
            "<3>  File x",
            r"<3>ValueError: a\x1b",
        ]

    def test_verbosity(self, monkeypatch):
        stream = io.StringIO()
        monkeypatch.setattr(sys, "stderr", stream)
        monkeypatch.delenv("JOURNAL_STREAM", raising=False)
        root = logging.getLogger()
        before = root.handlers[:], root.level
        try:
            for verbose, expected in ((0, []), (1, ["info"]), (2, ["info", "debug"])):
                stream.truncate(0)
                logs.configure(verbose)
                logging.getLogger("ahrsd.x").info("info")
                logging.getLogger("drivers.y").debug("debug")
                assert [line.split()[-1] for line in stream.getvalue().splitlines()] == expected
        finally:
            root.handlers[:], root.level = before
            for name in ("ahrsd", "drivers"):
                logging.getLogger(name).setLevel(logging.NOTSET)


@pytest.mark.parametrize(
    "words",
    [
        ["demo", "--seconds", "nan"],
        ["demo", "--speed", "nan"],
        ["demo", "--seed", "-1"],
        ["emulate", "--seed", "-1"],
        ["replay", "x.mcap", "--speed", "inf"],
        ["capture", "/dev/nowhere", "-o", "x.mcap", "--seconds", "nan"],
        ["evaluate", "x.mcap", "--calibration", "x.json", "--min-speed", "nan"],
        ["simulate", "mam", "-o", "x.csv", "--magnet", "nan"],
        ["simulate", "mam", "-o", "x.csv", "--step", "-1"],
        ["simulate", "mam", "-o", "x.csv", "--gap", "inf"],
    ],
)
def test_impossible_number_is_refused_and_named(run, capsys, words):
    assert run(*words) == EXIT_USAGE
    assert f"Invalid value for '{words[-2]}': {words[-1]}" in capsys.readouterr().err


def test_link_of_an_emulated_device_that_cannot_be_made_is_one_line(run, tmp_path, capsys):
    link = tmp_path / "nowhere" / "vn100"
    assert run("emulate", "--link", str(link)) == EXIT_USAGE
    told = capsys.readouterr().err
    assert told == f"ahrsd: --link {link}: cannot be made: No such file or directory\n"
