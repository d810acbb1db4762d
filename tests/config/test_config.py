"""The configuration: defaults, every kind of mistake, and a file that reloads to itself."""

from __future__ import annotations

import dataclasses
import datetime
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from ahrsd.config.config import (
    Config,
    check_config,
    core_settings,
    default_state_directory,
    load_config,
    print_config,
    reference,
    to_toml,
)
from ahrsd.config.sections import DeviceSection, GatesSection, Section
from ahrsd.errors import ConfigError
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.gates import GATES, GateLimits
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode

PROJECT = Path(__file__).parents[2]


def load(tmp_path: Path, text: str) -> Config:
    (tmp_path / "a.toml").write_text(text)
    return load_config(tmp_path / "a.toml")


def test_an_empty_file_is_the_harmless_default(tmp_path):
    config = load(tmp_path, "")
    assert config == Config()
    assert config.mode == "observe"
    assert config.write_back.approval == "operator"
    assert config.write_back.commit_unattended is False
    assert config.device.configure_stream is False
    assert config.interlock.file is None


def test_values_arrive_where_they_belong(tmp_path):
    config = load(
        tmp_path,
        """
        mode = "stage"
        state_directory = "/var/lib/ahrsd"
        [device]
        port = "~/vn100"
        baud = 921600
        rate_hz = 200
        [gates]
        max_heading_sigma_deg = 0.5
        [location]
        latitude_deg = 52.5
        longitude_deg = 13.4
        date = 2026-11-03
        """,
    )
    assert config.mode == "stage"
    assert config.device == DeviceSection(port=Path.home() / "vn100", baud=921600, rate_hz=200.0)
    assert config.gates == GatesSection(max_heading_sigma_deg=0.5)
    assert config.location.date == datetime.date(2026, 11, 3)
    assert config.captures == Path("/var/lib/ahrsd/captures")


def test_values_are_frozen():
    with pytest.raises(ValidationError, match="frozen"):
        Config().mode = "commit"
    with pytest.raises(ValidationError, match="frozen"):
        Config().gates.closure_deg = 0.0


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('mode = "obsrve"', "mode = 'obsrve': must be 'passive', 'observe', 'stage' or 'commit'"),
        ('modee = "stage"', "modee = 'stage': unknown key; did you mean mode?"),
        ("[gates]\nmax_heding_sigma_deg = 1.0", "did you mean max_heading_sigma_deg?"),
        (
            "[gate]\nclosure_deg = 1.0",
            "gate = {'closure_deg': 1.0}: unknown key; did you mean gates?",
        ),
        ("[interlock]\nxyz = 1", "interlock.xyz = 1: unknown key; known are file, max_age_s"),
        ("[gates]\nxyz = 1", "known are those of `ahrsd run --print-config`"),
        ("[device]\nport = 5", "device.port = 5: must be text, a path"),
        ('[device]\nport = ""', "device.port: is empty: write a path, or leave the key out"),
        ('state_directory = ""', "state_directory: is empty: write a path, or leave the key out"),
        ('[[share]]\npty = ""', "share.0.pty: is empty: write a path, or leave the key out"),
        ('[device]\nport = "a\\u0000"', r"'a\x00' has a character that no path can have"),
        ('[interlock]\nfile = "~no body/x"', "no user of that name has a home folder here"),
        ("[device]\nbaud = 9601", "device.baud = 9601: must be 'auto', 9600, 19200"),
        ("[device]\nrate_hz = 0.1", "device.rate_hz = 0.1: must be greater than or equal to 1"),
        ("[device]\nrate_hz = nan", "device.rate_hz = nan: must be less than or equal to 800"),
        ('[device]\nrate_hz = "fast"', "device.rate_hz = 'fast': must be a number"),
        ("[[share]]\ntcp = 15555", "share.0.tcp = 15555: must be text in quotes"),
        ("[device]\nserial_number = 1.5", "device.serial_number = 1.5: must be a whole number"),
        ('[device]\nconfigure_stream = "yes"', "= 'yes': must be true or false"),
        ("[device]\nconfigure_stream = 1", "device.configure_stream = 1: must be true or false"),
        ('[location]\ndate = "3 Nov"', "location.date = '3 Nov': must be a date such as"),
        ("[location]\nlatitude_deg = 5", "location: latitude_deg and longitude_deg must be given"),
        ("[gates]\nmax_step_auto_deg = 30", "must not be larger than max_step_operator_deg"),
        ("device = 3", "device = 3: this is a table, write [device]"),
        ("mode = observe", "is not TOML: Invalid value (at line 1, column 8)"),
        ("[device]\n[device]", "is not TOML: Cannot declare"),
    ],
)
def test_each_mistake_is_one_line_with_file_key_value_and_what_is_allowed(tmp_path, text, line):
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text)
    assert len(caught.value.lines) == 1
    assert caught.value.lines[0].startswith(f"{tmp_path / 'a.toml'}: ")
    assert line in caught.value.lines[0]
    assert "\n" not in caught.value.lines[0]


def test_all_mistakes_are_reported_at_once(tmp_path):
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, 'mode = "x"\n[device]\nrate_hz = 0\nprt = "a"\n')
    assert [line.split(": ")[1].split(" ")[0] for line in caught.value.lines] == [
        "mode",
        "device.rate_hz",
        "device.prt",
    ]


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        load_config(tmp_path / "missing.toml")
    (tmp_path / "a.toml").write_bytes(b"mode = '\xff'")
    with pytest.raises(ConfigError, match="not UTF-8"):
        load_config(tmp_path / "a.toml")


def test_the_printed_configuration_reloads_to_itself(tmp_path):
    assert load(tmp_path, print_config(Config())) == Config()
    changed = check_config(
        {
            "mode": "commit",
            "write_back": {"approval": "auto"},
            "device": {"port": '/dev/a "b" \\ é \U0001f600\x7f', "baud": 115200, "rate_hz": 12.5},
            "location": {
                "latitude_deg": -1e-7,
                "longitude_deg": 13.0,
                "date": datetime.date(2026, 1, 2),
            },
            "interlock": {"file": "/run/vehicle/safe"},
        },
        "test",
    )
    assert changed != Config()
    assert load(tmp_path, print_config(changed)) == changed


@given(st.text() | st.floats(allow_nan=False) | st.integers() | st.booleans() | st.dates())
def test_every_value_survives_toml(value):
    assert tomllib.loads(f"a = {to_toml(value)}")["a"] == value


def test_every_key_says_what_it_does():
    config = Config()
    for section in [config, *(v for _, v in config if isinstance(v, Section))]:
        assert type(section).__doc__
        for key, field in type(section).model_fields.items():
            if not isinstance(getattr(section, key), Section):
                assert field.description, f"{type(section).__name__}.{key}"


def test_the_estimators_defaults_have_one_source():
    assert Config().estimator.parameters() == EstimatorParameters()
    names = {field.name for field in dataclasses.fields(EstimatorParameters)}
    assert set(type(Config().estimator).model_fields) - {"warm_start_s"} == names - {
        "imperfections",
        "places",
    }


def test_the_gates_defaults_have_one_source():
    assert Config().gates.limits() == GateLimits()
    assert set(GatesSection.model_fields) == {
        field.name for field in dataclasses.fields(GateLimits)
    }
    assert {str(gate.limit) for gate in GATES} >= set(GatesSection.model_fields)


def test_the_write_backs_defaults_have_one_source():
    assert Config().write_back_policy() == WriteBackPolicy()
    config = check_config(
        {
            "mode": "commit",
            "device": {"serial_number": 7, "configure_stream": True},
            "interlock": {"max_age_s": 0.5},
            "write_back": {"approval": "auto", "keep_on_stop": True, "min_change_deg": 0.25},
            "budget": {"ram_writes_per_day": 2},
            "gates": {"max_step_auto_deg": 3.0},
            "trial": {"turns": 3.0, "interlock": False},
            "still": {"duration_s": 4.0},
        },
        "test",
    )
    policy = config.write_back_policy()
    assert (policy.mode, policy.serial, policy.configure_stream) == (Mode.COMMIT, 7, True)
    assert (policy.approval, policy.keep_on_stop) == ("auto", True)
    assert (policy.interlock_max_age_s, policy.min_change_deg) == (0.5, 0.25)
    assert policy.max_change_auto_deg == 3.0
    assert (policy.ram_writes_per_day, policy.still.duration_s) == (2, 4.0)
    assert (policy.trial.turns, policy.trial.interlock) == (3.0, False)


def test_the_state_directory(monkeypatch):
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/ahrsd:/other")
    assert default_state_directory() == Path("/var/lib/ahrsd")
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.setenv("XDG_STATE_HOME", "/home/x/.state")
    assert Config().state == Path("/home/x/.state/ahrsd")
    monkeypatch.delenv("XDG_STATE_HOME")
    assert default_state_directory() == Path.home() / ".local/state/ahrsd"


def test_the_reference_is_up_to_date():
    assert (PROJECT / "docs" / "reference" / "configuration.md").read_text() == reference(), (
        "run: python -m ahrsd.config.config > docs/reference/configuration.md"
    )


def test_the_command_line_names_the_state_directory_as_the_other_commands_do(tmp_path):
    from click.testing import CliRunner

    from ahrsd.cli.device.run import command

    said = CliRunner().invoke(command, ["--state-directory", str(tmp_path), "--print-config"])
    assert said.exit_code == 0
    assert load(tmp_path, said.output).state_directory == tmp_path


@pytest.mark.parametrize(
    ("share", "words"),
    [
        ("", "the place is missing: write one of pty, tcp and udp"),
        ('pty = "/x"\ntcp = "127.0.0.1:1"', "pty and tcp are both given"),
        ('tcp = "localhost:2101"', "such as 127.0.0.1:2101 or [::1]:2101; a name is not looked up"),
        ('tcp = "::1:2101"', "such as 127.0.0.1:2101 or [::1]:2101"),
        ('tcp = "[127.0.0.1]:2101"', "such as 127.0.0.1:2101 or [::1]:2101"),
        ('tcp = "127.0.0.1"', "such as 127.0.0.1:2101 or [::1]:2101"),
        ('udp = "127.0.0.1:70000"', "a port is 1 to 65535"),
        ('tcp = "0.0.0.0:2101"', "could be read by other machines; write other_hosts = true"),
        ('udp = "192.168.1.255:10110"', "would leave this machine; write other_hosts = true"),
        ('udp = "0.0.0.0:1"\nother_hosts = true', "no host has this address"),
        ('tcp = "224.0.0.1:1"\nother_hosts = true', "a multicast address is for udp only"),
        ('tcp = "127.0.0.1:2101"\nowner = true', "owner is for pty; this share is tcp"),
        ('udp = "127.0.0.1:2101"\ngroup = "x"', "group is for pty; this share is udp"),
        ('pty = "/x"\nsend = "nmea"', "send is for tcp and udp; this share is pty"),
        (
            'pty = "/x"\ncalibration = "pass"',
            'calibration = "pass" is for the share with owner = true',
        ),
        (
            'udp = "127.0.0.1:2101"\ncalibration = "pass"',
            "calibration is for pty; this share is udp",
        ),
        ('pty = "/x"\nownr = true', "share.0.ownr = True: unknown key; did you mean owner?"),
    ],
)
def test_impossible_share_is_refused_in_one_line(tmp_path, share, words):
    with pytest.raises(ConfigError) as error:
        load(tmp_path, f"[[share]]\n{share}\n")
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_shares_of_every_kind_come_back_from_their_text(tmp_path):
    config = load(
        tmp_path,
        '[[share]]\npty = "/x"\nowner = true\ncalibration = "pass"\n'
        '[[share]]\ntcp = "[::1]:2101"\nsend = "corrected"\ncalibrated_by = "registers"\n'
        '[[share]]\nudp = "192.168.1.255:10110"\nsend = "nmea"\nother_hosts = true\n',
    )
    names = [share.name for share in config.share]
    assert names == ["/x", "tcp [::1]:2101", "udp 192.168.1.255:10110"]
    assert load(tmp_path, print_config(config)) == config
    (policy,) = core_settings(config).shares
    assert (policy.name, policy.owner, policy.calibration) == ("/x", True, "pass")


def test_every_key_of_a_share_that_others_rely_on_is_accepted(tmp_path):
    config = load(
        tmp_path,
        '[[share]]\npty = "/x"\nowner = true\ncalibration = "guard"\nsave = "clean"\n'
        'reset = "announce"\nfactory_reset = "refuse"\n'
        '[[share]]\ntcp = "127.0.0.1:2101"\nsend = "raw"\n',
    )
    assert (config.share[0].calibration, config.share[0].factory_reset) == ("guard", "refuse")
    assert config.share[1].send == "raw"


@pytest.mark.parametrize("line", ['factory_reset = "pass"', 'save = "pass"'])
def test_a_share_lets_no_factory_reset_and_no_unproven_save_pass(tmp_path, line):
    with pytest.raises(ConfigError, match=line.partition(" ")[0]):
        load(tmp_path, f'[[share]]\npty = "/x"\nowner = true\n{line}\n')
