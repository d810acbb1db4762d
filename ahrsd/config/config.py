"""The configuration: read and checked, what the core takes of it, as text, and read again.

    config = load_config(Path("ahrsd.toml"))        # ConfigError: one line per wrong key

TOML, frozen, every wrong key named with its value and what is allowed. An unknown key is an error,
because a misspelt limit must not silently be the default.

**As text**: a commented file that loads to the same values, and the reference of all keys:

    python -m ahrsd.config.config > docs/reference/configuration.md

**Read again** while the daemon runs (SIGHUP):

    reload = Reloader(load, config)
    reload.ask()                         # in a signal handler; a thread of its own calls `load`
    for well, text in reload.take(apply) # once a second, in the daemon's loop: applied, and said

Only what is named in `MAY_CHANGE` takes effect at once: limits of the gates, the vehicle's files,
and how much is recorded. Everything else is a promise about the whole run (mode, device, who
approves, budgets) and waits for the next start, which is said. A file that is wrong in any place
changes nothing.
"""

from __future__ import annotations

import datetime
import difflib
import json
import os
import sys
import textwrap
import threading
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, ValidationError, field_validator, model_validator
from pydantic.fields import FieldInfo
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
from ahrsd.core.settings import CalibratorSettings, CoreSettings
from ahrsd.errors import ConfigError
from ahrsd.foreign_file import ForeignFileError, text_within
from ahrsd.sharing.arbiter import SharePolicy
from ahrsd.world_field import WorldField, world_field
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode as Ceiling

# -- Read and checked ------------------------------------------------------------------------------


Mode = Literal["passive", "observe", "stage", "commit"]

_LARGEST_BYTES = 1 << 20
_NAMES = 12  # more keys than this do not fit into one line
_WORDS = {  # where pydantic speaks of Python's types and not of TOML's
    "is_instance_of": "must be text, a path",
    "string_type": "must be text in quotes",
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


# -- What the core takes ---------------------------------------------------------------------------


_LARGEST_MODEL_BYTES = 16 << 20


def with_date(config: Config) -> Config:
    """The configuration with the date of the world model filled in, so that a replay has it too."""
    place = config.location
    if place.latitude_deg is None or place.date is not None:
        return config
    today = datetime.datetime.now(datetime.UTC).date()
    return config.model_copy(update={"location": place.model_copy(update={"date": today})})


def expected_field(config: Config) -> WorldField | None:
    """The world model's field where the configuration says a location, else None.

    Raises WorldFieldError where the model does not hold for the date.
    """
    place = with_date(config).location
    if place.latitude_deg is None or place.longitude_deg is None or place.date is None:
        return None
    day = place.date.timetuple().tm_yday - 1
    year = place.date.year + day / 365.25
    return world_field(place.latitude_deg, place.longitude_deg, place.height_m, year)


def core_settings(
    config: Config,
    *,
    stream_rate_hz: float | None = None,
    policy: WriteBackPolicy | None = None,
    held_out: bool = True,
) -> CoreSettings:
    """Settings of the core. `stream_rate_hz` is for recordings without time."""
    return CoreSettings(
        calibrator=CalibratorSettings(
            estimator=config.estimator.parameters(),
            limits=config.gates.limits(),
            world_field=expected_field(config),
            held_out=held_out,
        ),
        policy=policy or config.write_back_policy(),
        output_rate_hz=config.device.rate_hz,
        reply_timeout_s=config.device.reply_timeout_s,
        stream_rate_hz=stream_rate_hz,
        columns_max_age_s=config.terms.max_age_s,
        warm_start_s=config.estimator.warm_start_s,
        shares=tuple(
            SharePolicy(s.name, s.owner, s.save, s.reset, s.calibration)
            for s in config.share
            if s.pty is not None  # who reads over the network says nothing
        ),
    )


def terms_text(config: Config) -> str:
    """The text of `terms.model`, empty without one.  Raises ConfigError where it is none."""
    path = config.terms.model
    if path is None:
        return ""
    from ahrsd.diagnosis.repaired_model.model_file import (
        from_text,  # takes 50 MB: only where there is a model
    )

    try:
        text = text_within(path, _LARGEST_MODEL_BYTES)
        from_text(text)
    except ValueError as error:
        raise ConfigError([f"terms.model = {path}: {error}"]) from error
    return text


# -- As text ---------------------------------------------------------------------------------------


_WIDTH = 96
_SIGNS = ((Ge, "ge", ">="), (Gt, "gt", ">"), (Le, "le", "<="), (Lt, "lt", "<"))

_PREFACE = """\
# Configuration

`ahrsd run --config FILE` reads TOML; every key has a default, so an empty file is a configuration.
`ahrsd run --print-config` prints the one in force, with these comments. A key that is not here is
an error. From the code by `python -m ahrsd.config.config > docs/reference/configuration.md`.
"""


def print_config(config: Config) -> str:
    """TOML with a comment on each key; load_config of it gives an equal configuration."""
    lines: list[str] = []
    for name, section in _sections(config):
        lines += [""] * bool(lines)
        if name:
            title = f"[[{name}]]" if name in _listed() else f"[{name}]"
            lines += [*_comment(type(section).__doc__ or ""), title]
        for key, field in _keys(type(section)):
            value = getattr(section, key)
            allowed = _allowed(field)
            lines += _comment(_text(field) + f" ({allowed})" * bool(allowed))
            lines.append(f"# {key} =" if value is None else f"{key} = {to_toml(value)}")
    return "\n".join(lines) + "\n"


def reference() -> str:
    """The reference of all keys, in Markdown."""
    lines = [_PREFACE]
    for name, section in [*_sections(Config()), *_listed().items()]:
        title = f"## `[{name}]`" if name else "## Keys in front of all tables"
        title = f"## `[[{name}]]`, as often as needed" if name in _listed() else title
        lines += [title, "", type(section).__doc__ or "", ""]
        lines += ["| key | default | allowed | effect |", "|---|---|---|---|"]
        for key, field in _keys(type(section)):
            value = field.get_default()
            default = "" if value is None else f"`{to_toml(value)}`"
            lines.append(f"| `{key}` | {default} | {_allowed(field)} | {_text(field)} |")
        lines.append("")
    return "\n".join(lines)


def to_toml(value: object) -> str:
    """One value as TOML spells it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, date):
        return value.isoformat()
    text = str(value) if isinstance(value, Path) else value
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _sections(config: Config) -> Iterator[tuple[str, BaseModel]]:
    yield "", config
    for name in type(config).model_fields:
        value = getattr(config, name)
        if isinstance(value, BaseModel):
            yield name, value
        elif name in _listed():
            yield from ((name, one) for one in value)


def _listed() -> dict[str, BaseModel]:
    """Tables that may be there several times, with their defaults."""
    return {name: section.model_construct() for name, section in listed_sections().items()}


def _keys(section: type[BaseModel]) -> Iterator[tuple[str, FieldInfo]]:
    for name, field in section.model_fields.items():
        if not isinstance(field.get_default(), BaseModel) and name not in _listed():
            yield name, field


def _text(field: FieldInfo) -> str:
    return " ".join((field.description or "").split())


def _allowed(field: FieldInfo) -> str:
    """What a key takes: its choices, its limits, or its type."""
    if get_origin(field.annotation) is Literal:
        return " ".join(to_toml(choice) for choice in get_args(field.annotation))
    limits = [
        f"{sign} {getattr(limit, name):.12g}"
        for kind, name, sign in _SIGNS
        for limit in field.metadata
        if isinstance(limit, kind)
    ]
    return ", ".join(limits) or _kind(field.annotation)


def _kind(annotation: object) -> str:
    kinds = get_args(annotation) or (annotation,)
    names = {bool: "true or false", Path: "path", date: "date"}
    return " ".join(names[kind] for kind in kinds if kind in names)


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")


# -- Read again while the daemon runs --------------------------------------------------------------


#: table -> keys of it; None: all but those that are also part of another promise
MAY_CHANGE: dict[str, frozenset[str] | None] = {
    "gates": None,
    "interlock": frozenset({"file"}),
    "terms": frozenset({"file"}),
    "capture": frozenset({"part_megabytes", "keep_megabytes"}),
}
_NOT = frozenset({"gates.max_step_auto_deg"})  # who approves what


@dataclass(frozen=True, slots=True)
class Change:
    """What a new configuration brings.

    config: the one in force from now on; changed: keys with their new values; waits: keys that
    only the next start takes
    """

    config: Config
    changed: tuple[str, ...]
    waits: tuple[str, ...]


def merged(old: Config, new: Config) -> Change:
    """The old configuration with what may change taken from the new one."""
    changed: list[str] = []
    waits: list[str] = []
    tables: dict[str, BaseModel] = {}
    for name in Config.model_fields:
        before, after = getattr(old, name), getattr(new, name)
        if before == after:
            continue
        if not isinstance(before, BaseModel):
            waits.append(name)
            continue
        taken: dict[str, Any] = {}
        for key in type(before).model_fields:
            value = getattr(after, key)
            if getattr(before, key) == value:
                continue
            if may_change(name, key):
                taken[key] = value
                changed.append(f"{name}.{key} = {'none' if value is None else to_toml(value)}")
            else:
                waits.append(f"{name}.{key}")
        tables[name] = before.model_copy(update=taken)
    return Change(old.model_copy(update=tables), tuple(changed), tuple(waits))


def may_change(table: str, key: str) -> bool:
    """Whether a running daemon takes this key."""
    keys = MAY_CHANGE.get(table, frozenset())
    return f"{table}.{key}" not in _NOT and (keys is None or key in keys)


class Reloader:
    """Reads the file when asked to; only its own thread waits for it."""

    def __init__(self, load: Callable[[], Config] | None, config: Config) -> None:
        self.config = config
        self._load = load
        self._found: SimpleQueue[Config | ConfigError] = SimpleQueue()

    def ask(self) -> None:
        """Read it again; safe in a signal handler."""
        threading.Thread(target=self._read, name="reload", daemon=True).start()

    def _read(self) -> None:
        if self._load is None:
            self._found.put(ConfigError(["there is no file to read again: give --config"]))
            return
        try:
            self._found.put(self._load())
        except ConfigError as error:
            self._found.put(error)

    def take(self, apply: Callable[[Change], None]) -> list[tuple[bool, str]]:
        """Apply what was read since the last call; (whether it is well, a sentence) for the log."""
        said: list[tuple[bool, str]] = []
        while not self._found.empty():
            found = self._found.get()
            if isinstance(found, ConfigError):
                said += [(False, f"the old configuration stays: {line}") for line in found.lines]
                continue
            change = merged(self.config, found)
            if change.changed:
                self.config = change.config
                apply(change)
            text = (
                ", ".join(change.changed) or "no setting that may change during a run has changed"
            )
            said.append((True, f"configuration read again: {text}"))
            if change.waits:
                said.append(
                    (
                        False,
                        f"these settings change at the next start only: {', '.join(change.waits)}",
                    )
                )
        return said


if __name__ == "__main__":
    sys.stdout.write(reference())
