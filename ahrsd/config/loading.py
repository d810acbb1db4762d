"""The configuration: TOML, frozen, every wrong key named with its value and what is allowed.

    config = load_config(Path("ahrsd.toml"))        # ConfigError: one line per wrong key

An unknown key is an error, because a misspelt limit must not silently be the default.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails

from ahrsd.config.sections import (
    BudgetSection,
    CaptureSection,
    DeviceSection,
    EstimatorSection,
    GatesSection,
    InterlockSection,
    LocationSection,
    MetricsSection,
    RerunSection,
    Section,
    ShareSection,
    SocketSection,
    StillSection,
    TermsSection,
    TrialSection,
    WriteBackSection,
)
from ahrsd.errors import ConfigError
from ahrsd.foreign_file import ForeignFileError, text_within
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode as Ceiling

Mode = Literal["passive", "observe", "stage", "commit"]

_LARGEST_BYTES = 1 << 20
_NAMES = 12  # more keys than this do not fit into one line
_WORDS = {  # where pydantic speaks of Python's types and not of TOML's
    "is_instance_of": "must be text, a path",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "float_type": "must be a number",
    "date_type": "must be a date such as 2026-11-03, without quotes",
}


class Config(Section):
    """Everything that a person can set."""

    mode: Mode = "observe"
    """passive sends no byte; observe only reads registers and says what it would write; stage may
    write RAM; commit may write flash."""
    state_directory: Path | None = None
    """Journals and captures; default: $STATE_DIRECTORY (systemd), else ~/.local/state/ahrsd."""
    device: DeviceSection = DeviceSection()
    share: tuple[ShareSection, ...] = ()
    """Ports on which other programs find the device."""
    capture: CaptureSection = CaptureSection()
    rerun: RerunSection = RerunSection()
    socket: SocketSection = SocketSection()
    metrics: MetricsSection = MetricsSection()
    estimator: EstimatorSection = EstimatorSection()
    gates: GatesSection = GatesSection()
    interlock: InterlockSection = InterlockSection()
    terms: TermsSection = TermsSection()
    location: LocationSection = LocationSection()
    write_back: WriteBackSection = WriteBackSection()
    trial: TrialSection = TrialSection()
    still: StillSection = StillSection()
    budget: BudgetSection = BudgetSection()

    @field_validator("share", mode="before")
    @classmethod
    def _tables(cls, value: object) -> object:
        """TOML has lists only."""
        if isinstance(value, dict) or (isinstance(value, list) and not _all_tables(value)):
            raise ValueError("write [[share]], once for each port")
        return tuple(value) if isinstance(value, list) else value

    @model_validator(mode="after")
    def _shares_fit(self) -> Config:
        names = [share.name for share in self.share]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"share: {twice[0]} is there twice")
        owners = [share.name for share in self.share if share.owner]
        if len(owners) > 1:
            raise ValueError(f"share: {' and '.join(owners)} are both owner; at most one can be")
        if owners and self.device.configure_stream:
            raise ValueError(
                f"device.configure_stream: the outputs are set by the owner of {owners[0]}; set "
                "it to false, or give that share owner = false"
            )
        return self

    @property
    def state(self) -> Path:
        """The state directory in force."""
        return self.state_directory or default_state_directory()

    @property
    def captures(self) -> Path:
        """The folder of the captures in force."""
        return self.capture.directory or self.state / "captures"

    def write_back_policy(self) -> WriteBackPolicy:
        """What the write-back takes, collected from the tables that a person sees."""
        return WriteBackPolicy(
            mode=Ceiling[self.mode.upper()],
            configure_stream=self.device.configure_stream,
            serial=self.device.serial_number,
            interlock_max_age_s=self.interlock.max_age_s,
            reply_timeout_s=self.device.reply_timeout_s,
            max_change_auto_deg=self.gates.max_step_auto_deg,
            trial=self.trial.policy(),
            still=self.still.policy(),
            **self.write_back.model_dump(),
            **self.budget.model_dump(),
        )


def _all_tables(values: list[object]) -> bool:
    return all(isinstance(value, dict) for value in values)


CONFIG_KEY = "config"  # where a capture's header keeps the configuration it was made with


def recorded_config(text: str) -> Config:
    """The configuration in a capture's header, TOML.  Raises ConfigError where it is not one."""
    source = "the capture's configuration"
    try:
        return check_config(tomllib.loads(text), source)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError([f"{source}: is not TOML: {error}"]) from error


def default_state_directory() -> Path:
    """$STATE_DIRECTORY as systemd sets it, else the user's own (XDG base directories)."""
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "ahrsd"


def load_config(path: Path) -> Config:
    """Read and check a file.  Raises ConfigError with one line per wrong key."""
    try:
        body = tomllib.loads(text_within(path, _LARGEST_BYTES))
    except ForeignFileError as error:
        raise ConfigError([f"{path}: {error}"]) from error
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError([f"{path}: is not TOML: {error}"]) from error
    return check_config(body, str(path))


def check_config(body: dict[str, Any], source: str) -> Config:
    """A configuration from keys and values; `source` is how the errors call it."""
    try:
        return Config.model_validate(body)
    except ValidationError as error:
        # a choice such as "auto or a rate" reports once per alternative: one line is enough
        lines = dict.fromkeys(f"{source}: {_explain(detail)}" for detail in error.errors())
        raise ConfigError(list(lines)) from error


def section_of(location: tuple[int | str, ...]) -> type[BaseModel]:
    """The table that holds the key at `location`."""
    name = str(location[0])
    if len(location) == 1:
        return Config
    if (listed := listed_sections().get(name)) is not None:
        return listed
    annotation = Config.model_fields[name].annotation
    return annotation if isinstance(annotation, type) else Config


def listed_sections() -> dict[str, type[Section]]:
    """Tables that may be there several times, by name: those that a tuple holds."""
    found = {}
    for name, field in Config.model_fields.items():
        inside = get_args(field.annotation)
        if inside and isinstance(inside[0], type) and issubclass(inside[0], Section):
            found[name] = inside[0]
    return found


def _explain(detail: ErrorDetails) -> str:
    location = detail["loc"]
    key = ".".join(str(part) for part in location)
    if detail["type"] == "extra_forbidden":
        known = list(section_of(location).model_fields)
        alike = difflib.get_close_matches(str(location[-1]), known, n=1, cutoff=0.6)
        names = ", ".join(known) if len(known) <= _NAMES else "those of `ahrsd run --print-config`"
        hint = f"did you mean {alike[0]}?" if alike else f"known are {names}"
        return f"{key} = {detail['input']!r}: unknown key; {hint}"
    if not location or detail["type"] == "value_error":
        text = detail["msg"].removeprefix("Value error, ")
        return f"{key}: {text}" if key else text
    if detail["type"] == "model_type":
        return f"{key} = {detail['input']!r}: this is a table, write [{key}]"
    words = _WORDS.get(detail["type"], detail["msg"].replace("Input should be", "must be"))
    return f"{key} = {detail['input']!r}: {words}"
