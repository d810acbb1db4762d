"""The tables of the configuration file: each key with its limits, and below it what it does.

The text under a key ends in its unit; which way a limit pushes is said where it is not plain. The
defaults of `[estimator]` and `[gates]` are those of the code that uses them. Addresses of network
shares are an IP address and a port, in numbers; nothing is looked up.
"""

from __future__ import annotations

import datetime
import ipaddress
import re
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from ahrsd.estimator.parameters import MIN_EPOCH_STEPS, EstimatorParameters
from ahrsd.gates import GateLimits
from ahrsd.writeback.policy import StillPolicy, WriteBackPolicy
from ahrsd.writeback.trial import TrialPolicy

# -- Addresses of network shares -------------------------------------------------------------------


_FORM = re.compile(r"(?:\[(?P<six>[^\]]+)\]|(?P<four>[^:\[\]]+)):(?P<port>\d{1,5})")


@dataclass(frozen=True, slots=True)
class Address:
    """Where to listen or to send. `text` is how a person wrote it."""

    text: str
    ip: ipaddress.IPv4Address | ipaddress.IPv6Address
    port: int

    @staticmethod
    def parse(key: str, text: str) -> Address:
        """From `127.0.0.1:2101` or `[::1]:2101`. Raises ValueError, which names the key."""
        example = "write an IP address and a port, such as 127.0.0.1:2101 or [::1]:2101"
        found = _FORM.fullmatch(text)
        if found is None:
            raise ValueError(f"{key} = {text!r}: {example}")
        try:
            ip = ipaddress.ip_address(found["six"] or found["four"])
        except ValueError:
            hint = "; a name is not looked up" if found["four"] else ""
            raise ValueError(f"{key} = {text!r}: {example}{hint}") from None
        if (ip.version == 6) != (found["six"] is not None):
            raise ValueError(f"{key} = {text!r}: {example}")
        port = int(found["port"])
        if not 1 <= port <= 65535:
            raise ValueError(f"{key} = {text!r}: a port is 1 to 65535")
        return Address(text, ip, port)

    def check(self, key: str, *, other_hosts: bool) -> None:
        """Raise ValueError where this cannot be meant, or needs a word that was not given."""
        if key == "udp" and self.ip.is_unspecified:
            raise ValueError(
                f"{key} = {self.text!r}: no host has this address; give the one to send to"
            )
        if key == "tcp" and self.ip.is_multicast:
            raise ValueError(f"{key} = {self.text!r}: a multicast address is for udp only")
        if not self.ip.is_loopback and not other_hosts:
            what = "would leave this machine" if key == "udp" else "could be read by other machines"
            raise ValueError(
                f"{key} = {self.text!r}: what is sent {what}; write other_hosts = true if that is "
                "intended, or choose an address of this machine alone, such as 127.0.0.1"
            )

    @property
    def family(self) -> socket.AddressFamily:
        """For `socket.socket`."""
        return socket.AF_INET6 if self.ip.version == 6 else socket.AF_INET

    @property
    def place(self) -> tuple[str, int]:
        """For `bind` and `sendto`."""
        return str(self.ip), self.port


# -- The sections ----------------------------------------------------------------------------------


Baud = Literal["auto", 9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600]


_PLACES: Final = ("pty", "tcp", "udp")  # of a share, exactly one
_KEYS_OF: Final = {  # which of them a key of a share is for
    **dict.fromkeys(("owner", "save", "reset", "factory_reset", "calibration", "group"), ("pty",)),
    **dict.fromkeys(
        ("send", "other_hosts", "calibrated_by", "max_heading_sigma_deg"), ("tcp", "udp")
    ),
}


class Section(BaseModel):
    """A table of the file: frozen, nothing converted, nothing unknown."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True
    )

    @field_validator("*", mode="before")
    @classmethod
    def _paths(cls, value: object, info: ValidationInfo) -> object:
        """TOML has no paths: text becomes one where a path is wanted; `~` is the home folder."""
        name = info.field_name or ""
        wants_path = cls.model_fields[name].annotation == Path | None
        return _path(value) if wants_path and isinstance(value, str) else value


def _path(text: str) -> Path:
    """Raises ValueError where no file can have that name."""
    if not text:
        raise ValueError("is empty: write a path, or leave the key out")
    if "\0" in text:
        raise ValueError(f"{text!r} has a character that no path can have")
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise ValueError(f"{text!r}: no user of that name has a home folder here") from error


class DeviceSection(Section):
    """The VN-100 and its port."""

    port: Path | None = None
    """Serial port; best by its stable name in /dev/serial/by-id. Also one of a device server on the
    network: socket://HOST:PORT (the server has the rate) or rfc2217://HOST:PORT."""
    serial_number: int | None = Field(default=None, ge=0, le=2**32 - 1)
    """Accept only the device with this serial number (register 3)."""
    baud: Baud = "auto"
    """Rate of the port; auto tries each rate and never changes the device's. [Bd]"""
    configure_stream: bool = False
    """Allow changing the async and binary outputs in RAM for the session, in any mode but passive;
    they are put back at exit."""
    rate_hz: float = Field(default=100.0, ge=1.0, le=800.0)
    """Rate of the binary output that configure_stream sets up. [Hz]"""
    reply_timeout_s: float = Field(default=0.4, ge=0.05, le=60.0)
    """How long a reply may take before the request is repeated. [s]"""


class ShareSection(Section):
    """A place where another program finds the device: a port of its own, or an address."""

    pty: Path | None = None
    """Path of a port; the other program opens it in place of the device's own."""
    tcp: str | None = None
    """Address to listen at, such as 127.0.0.1:2101 or [::1]:2101; a connected program can only
    read."""
    udp: str | None = None
    """Address to send to, such as 127.0.0.1:5005: a datagram for each message."""
    send: Literal["raw", "corrected", "nmea"] = "raw"
    """What tcp and udp send; raw: the device's messages byte for byte; corrected: JSON lines with
    the calibrated field and rate (docs/reference/socket.md); nmea: HDM and XDR, ten a second."""
    other_hosts: bool = False
    """Needed for an address of tcp or udp that is not of this machine alone (127.0.0.0/8, ::1)."""
    calibrated_by: Literal["registers", "qualified"] = "registers"
    """What corrected and nmea are calibrated by; registers: only what is in the device; qualified:
    a candidate that passed every gate is applied here, before and without a write or an approval,
    so the heading changes while the vehicle is under way."""
    max_heading_sigma_deg: float = Field(default=5.0, gt=0.0, le=180.0)
    """A magnetic heading that is less certain than this (1 sigma) is left out of corrected and
    nmea. [deg]"""
    owner: bool = False
    """The program on the pty may set outputs and other settings of the device, in RAM; at most one
    may. The others read and listen. Nobody may write calibration registers (but see the key
    calibration)."""
    save: Literal["refuse", "clean"] = "clean"
    """What is done with the owner's VNWNV; clean: it is sent once the device's RAM holds nothing
    unproven (a calibration on trial is undone first and written again afterwards)."""
    reset: Literal["refuse", "announce"] = "announce"
    """What is done with the owner's VNRST; announce: it is sent, and ahrsd expects the restart (a
    calibration on trial is undone first and written again afterwards)."""
    factory_reset: Literal["refuse"] = "refuse"
    """What is done with VNRFS, from anybody: VNERR 09; it would erase all settings in the flash."""
    calibration: Literal["guard", "pass"] = "guard"
    """What is done with the owner's writes of registers 23, 25, 26, 43, 44, 74 and 84; guard: VNERR
    09; pass: journaled and sent, in mode stage and commit, while no calibration of ahrsd's is under
    way."""
    group: str | None = None
    """Group that may open the pty; default: the daemon's."""

    @model_validator(mode="after")
    def _is_one_place(self) -> ShareSection:
        given = [kind for kind in _PLACES if getattr(self, kind) is not None]
        if len(given) != 1:
            found = f"{' and '.join(given)} are both given" if given else "the place is missing"
            raise ValueError(f"{found}: write one of pty, tcp and udp; a [[share]] for each")
        for key, kind in _KEYS_OF.items():
            set_ = getattr(self, key) != type(self).model_fields[key].get_default()
            if set_ and given[0] not in kind:
                raise ValueError(f"{key} is for {' and '.join(kind)}; this share is {given[0]}")
        if self.calibration == "pass" and not self.owner:
            raise ValueError('calibration = "pass" is for the share with owner = true')
        if self.pty is None:
            self.address.check(self.kind, other_hosts=self.other_hosts)
        return self

    @property
    def kind(self) -> str:
        """pty, tcp or udp."""
        return next(kind for kind in _PLACES if getattr(self, kind) is not None)

    @property
    def name(self) -> str:
        """How people and the log call it."""
        return str(self.pty) if self.pty is not None else f"{self.kind} {getattr(self, self.kind)}"

    @property
    def address(self) -> Address:
        """Of tcp and udp. Raises ValueError where it is none."""
        return Address.parse(self.kind, str(getattr(self, self.kind)))


class CaptureSection(Section):
    """The record of everything received and sent, raw."""

    enabled: bool = True
    """Record; a session without a capture cannot be replayed."""
    directory: Path | None = None
    """Folder of the captures; default: captures in the state directory."""
    part_megabytes: int = Field(default=64, ge=1, le=10**6)
    """A new file begins at this size. [MB]"""
    keep_megabytes: int = Field(default=2048, ge=16, le=10**8)
    """The oldest captures are removed beyond this sum. [MB]"""


class RerunSection(Section):
    """The log for the rerun viewer, written by a separate process."""

    file: Path | None = None
    """Write an .rrd file here."""
    serve: bool = False
    """Serve a live view to a viewer on this machine."""
    port: int = Field(default=9876, ge=1024, le=65535)
    """TCP port of the live view, on 127.0.0.1 only."""
    memory_megabytes: int = Field(default=256, ge=16, le=10**5)
    """Memory of the live view for viewers that connect later. [MB]"""


class SocketSection(Section):
    """The Unix socket that `ahrsd status`, `watch` and `explain` ask (docs/reference/socket.md)."""

    enabled: bool = True
    """Serve; who may connect is decided by the permissions of the socket's file."""
    path: Path | None = None
    """Its file; default: $RUNTIME_DIRECTORY/socket (systemd), else in the state directory."""


class MetricsSection(Section):
    """Numbers for Prometheus, over HTTP on 127.0.0.1 only."""

    enabled: bool = False
    """Serve /metrics."""
    port: int = Field(default=9190, ge=1024, le=65535)
    """TCP port."""


_ESTIMATOR = EstimatorParameters()


class EstimatorSection(Section):
    """The estimate of iron and gyro bias."""

    step_rate_hz: float = Field(default=_ESTIMATOR.step_rate_hz, ge=1.0, le=800.0)
    """Faster streams are averaged down to this; a higher rate follows faster motion and costs more.
    [Hz]"""
    epoch_steps: int = Field(default=_ESTIMATOR.epoch_steps, ge=MIN_EPOCH_STEPS, le=65536)
    """Steps per epoch; a larger number loses less at the borders and gives results later.
    [steps]"""
    window_steps: int = Field(default=_ESTIMATOR.window_steps, ge=64, le=10**6)
    """Steps that are linearised again; a larger number is nearer to the batch result. [steps]"""
    bias_walk_rad_s_sqrt_s: float = Field(
        default=_ESTIMATOR.bias_walk_rad_s_sqrt_s, ge=0.0, le=0.01
    )
    """Random walk of the gyro bias; larger follows temperature faster. [rad/s/sqrt(s)]"""
    prior_soft_iron: float = Field(default=_ESTIMATOR.prior_soft_iron, gt=0.0, le=10.0)
    """1 sigma of the soft iron around the device's present value; smaller trusts the device more.
    [1]"""
    prior_hard_iron_gauss: float = Field(default=_ESTIMATOR.prior_hard_iron_gauss, gt=0.0, le=10.0)
    """The same for the hard iron. [gauss]"""
    prior_gyro_bias_rad_s: float = Field(default=_ESTIMATOR.prior_gyro_bias_rad_s, gt=0.0, le=1.0)
    """The same for the gyro bias. [rad/s]"""
    outlier_sigma: float = Field(default=_ESTIMATOR.outlier_sigma, ge=2.0, le=100.0)
    """Field residuals beyond this lose weight; a smaller number ignores more. [sigma]"""
    mag_noise_floor_gauss: float = Field(default=_ESTIMATOR.mag_noise_floor_gauss, gt=0.0, le=1.0)
    """The field noise is assumed to be at least this. [gauss]"""
    gyro_noise_floor_rad_s: float = Field(default=_ESTIMATOR.gyro_noise_floor_rad_s, gt=0.0, le=1.0)
    """The rate noise is assumed to be at least this. [rad/s]"""

    warm_start_s: float = Field(default=1800.0, ge=0.0, le=7200.0)
    """At its start `ahrsd run` continues with the samples of the newest captures of the same
    device, with the same registers and not older than this; 0: every run begins without samples.
    [s]"""

    @model_validator(mode="after")
    def _window_of_epochs(self) -> EstimatorSection:
        if self.window_steps < self.epoch_steps:
            raise ValueError("window_steps must not be smaller than epoch_steps")
        return self

    def parameters(self) -> EstimatorParameters:
        """What the estimator takes."""
        return EstimatorParameters(**self.model_dump(exclude={"warm_start_s"}))


_LIMITS = GateLimits()
_ORDERED = (
    ("field_min_gauss", "field_max_gauss"),
    ("field_spread_flash_percent", "field_spread_ram_percent"),
    ("min_diagonal", "max_diagonal"),
    ("max_condition_auto", "max_condition_operator"),
    ("max_offset_auto_gauss", "max_offset_operator_gauss"),
    ("max_step_auto_deg", "max_step_operator_deg"),
)


class GatesSection(Section):
    """What must hold before anything is written, one limit per gate (docs/reference/gates.md)."""

    max_error_rate: float = Field(default=_LIMITS.max_error_rate, ge=0.0, le=1.0)
    """Share of messages with a wrong checksum. [1]"""
    max_drop_rate: float = Field(default=_LIMITS.max_drop_rate, ge=0.0, le=1.0)
    """Share of samples that are missing. [1]"""
    min_rate_hz: float = Field(default=_LIMITS.min_rate_hz, ge=1.0, le=800.0)
    """Sample rate. [Hz]"""
    min_heading_excursion_deg: float = Field(
        default=_LIMITS.min_heading_excursion_deg, ge=0.0, le=360.0
    )
    """Headings covered, in sectors of 10 deg. [deg]"""
    min_planar_circle_deg: float = Field(default=_LIMITS.min_planar_circle_deg, ge=0.0, le=360.0)
    """The same where the motion is planar: a whole circle is needed. [deg]"""
    min_observability: float = Field(default=_LIMITS.min_observability, ge=0.0, le=100.0)
    """Weakest direction of the information, 1 = just enough. [1]"""
    max_heading_sigma_deg: float = Field(default=_LIMITS.max_heading_sigma_deg, ge=0.0, le=180.0)
    """Expected heading error (1 sigma) at the worst attitude driven. [deg]"""
    max_moved_unseen_gauss: float = Field(default=_LIMITS.max_moved_unseen_gauss, ge=0.0, le=2.5)
    """Change of the vertical hard iron although the motion was too flat to determine it. [gauss]"""
    field_min_gauss: float = Field(default=_LIMITS.field_min_gauss, ge=0.0, le=2.5)
    """Smallest corrected field; nowhere on Earth is it weaker than the limit. [gauss]"""
    field_max_gauss: float = Field(default=_LIMITS.field_max_gauss, ge=0.0, le=2.5)
    """Largest corrected field; nowhere on Earth is it stronger than the limit. [gauss]"""
    field_model_percent: float = Field(default=_LIMITS.field_model_percent, ge=0.0, le=100.0)
    """Mean corrected field against the world model. [%]"""
    field_spread_ram_percent: float = Field(
        default=_LIMITS.field_spread_ram_percent, ge=0.0, le=100.0
    )
    """Standard deviation of the corrected field over its mean. [%]"""
    field_spread_flash_percent: float = Field(
        default=_LIMITS.field_spread_flash_percent, ge=0.0, le=100.0
    )
    """The same, for a save to flash. [%]"""
    max_inclination_error_deg: float = Field(
        default=_LIMITS.max_inclination_error_deg, ge=0.0, le=180.0
    )
    """Dip of the corrected field against the world model. [deg]"""
    max_place_deg: float = Field(default=_LIMITS.max_place_deg, ge=0.0, le=180.0)
    """Heading error (1 sigma) by a field that differs from place to place, and by all else that
    the model does not explain. [deg]"""
    holdout_segments: float = Field(default=_LIMITS.holdout_segments, ge=0.0, le=100.0)
    """Held-out segments that turned by 60 deg and more. [segments]"""
    min_holdout_excursion_deg: float = Field(
        default=_LIMITS.min_holdout_excursion_deg, ge=0.0, le=360.0
    )
    """Headings covered in the held-out segments. [deg]"""
    holdout_rms_deg: float = Field(default=_LIMITS.holdout_rms_deg, ge=0.0, le=180.0)
    """Magnetic against gyro heading on held-out data, rms. [deg]"""
    holdout_max_deg: float = Field(default=_LIMITS.holdout_max_deg, ge=0.0, le=180.0)
    """The same, largest second. [deg]"""
    closure_deg: float = Field(default=_LIMITS.closure_deg, ge=0.0, le=180.0)
    """Change of the heading error over a full turn. [deg]"""
    min_improvement_percent: float = Field(
        default=_LIMITS.min_improvement_percent, ge=0.0, le=100.0
    )
    """Reduction of the held-out rms against the calibration in force. [%]"""
    min_improvement_deg: float = Field(default=_LIMITS.min_improvement_deg, ge=0.0, le=180.0)
    """The same in degrees. [deg]"""
    min_improvement_lower_deg: float = Field(
        default=_LIMITS.min_improvement_lower_deg, ge=0.0, le=180.0
    )
    """Lower end of the 95 % interval of that improvement. [deg]"""
    repeat_hard_iron_gauss: float = Field(default=_LIMITS.repeat_hard_iron_gauss, ge=0.0, le=2.5)
    """Level hard iron of the earlier half of the data against the later half. [gauss]"""
    repeat_heading_deg: float = Field(default=_LIMITS.repeat_heading_deg, ge=0.0, le=180.0)
    """Heading by the earlier half of the data against the later one, worst heading and tilt.
    [deg]"""
    second_opinion_deg: float = Field(default=_LIMITS.second_opinion_deg, ge=0.0, le=180.0)
    """Heading by an independent fit without gyro, worst heading and tilt. [deg]"""
    min_eigenvalue: float = Field(default=_LIMITS.min_eigenvalue, ge=0.0, le=100.0)
    """Smallest eigenvalue of the symmetric part of C. [1]"""
    min_diagonal: float = Field(default=_LIMITS.min_diagonal, ge=0.0, le=100.0)
    """Smallest diagonal element of C. [1]"""
    max_diagonal: float = Field(default=_LIMITS.max_diagonal, ge=0.0, le=100.0)
    """Largest diagonal element of C. [1]"""
    max_condition_auto: float = Field(default=_LIMITS.max_condition_auto, ge=1.0, le=100.0)
    """Condition number of C without a person. [1]"""
    max_condition_operator: float = Field(default=_LIMITS.max_condition_operator, ge=1.0, le=100.0)
    """Condition number of C with a person's approval. [1]"""
    max_offset_auto_gauss: float = Field(default=_LIMITS.max_offset_auto_gauss, ge=0.0, le=2.5)
    """Hard iron without a person. [gauss]"""
    max_offset_operator_gauss: float = Field(
        default=_LIMITS.max_offset_operator_gauss, ge=0.0, le=2.5
    )
    """Hard iron with a person's approval. [gauss]"""
    max_scale_change_percent: float = Field(
        default=_LIMITS.max_scale_change_percent, ge=0.0, le=100.0
    )
    """Change of scale where no position is known: the motion does not determine it. [%]"""
    max_step_auto_deg: float = Field(default=_LIMITS.max_step_auto_deg, ge=0.0, le=180.0)
    """Worst heading change without a person, whatever `write_back.approval` says. [deg]"""
    max_step_operator_deg: float = Field(default=_LIMITS.max_step_operator_deg, ge=0.0, le=180.0)
    """Worst heading change against an earlier calibration, with a person's approval. [deg]"""
    max_field_change_gauss: float = Field(default=_LIMITS.max_field_change_gauss, ge=0.0, le=2.5)
    """Corrected field of a segment against the median segment. [gauss]"""
    max_inclination_change_deg: float = Field(
        default=_LIMITS.max_inclination_change_deg, ge=0.0, le=180.0
    )
    """Dip of a calm segment against the median segment. [deg]"""
    max_temperature_drift_c: float = Field(
        default=_LIMITS.max_temperature_drift_c, ge=0.0, le=100.0
    )
    """Range of the sensor's temperature. [degC]"""
    max_gyro_bias_deg_s: float = Field(default=_LIMITS.max_gyro_bias_deg_s, ge=0.0, le=100.0)
    """Gyro bias. [deg/s]"""
    min_rest_s: float = Field(default=_LIMITS.min_rest_s, ge=0.0, le=3600.0)
    """Rest within the last quarter of an hour. [s]"""
    max_gyro_sigma_share: float = Field(default=_LIMITS.max_gyro_sigma_share, ge=0.0, le=1.0)
    """Sigma of the mean rate at rest over the change that is written. [1]"""
    max_gyro_disagreement: float = Field(default=_LIMITS.max_gyro_disagreement, ge=0.0, le=100.0)
    """Gyro bias of the estimate against the mean rate at rest. [sigma]"""
    max_gyro_apart_mrad_s: float = Field(default=_LIMITS.max_gyro_apart_mrad_s, ge=0.0, le=100.0)
    """The same as a rate. [mrad/s]"""

    @model_validator(mode="after")
    def _in_order(self) -> GatesSection:
        for low, high in _ORDERED:
            if getattr(self, low) > getattr(self, high):
                raise ValueError(f"{low} must not be larger than {high}")
        return self

    def limits(self) -> GateLimits:
        """What the gates take."""
        return GateLimits(**self.model_dump())


class InterlockSection(Section):
    """The vehicle's report that a write is safe now."""

    file: Path | None = None
    """File that the vehicle keeps rewriting while it is safe, its content the word safe; without
    one, or with any other content, nothing is ever written. A regular file of 64 bytes at most; a
    file from before the start counts once it is written again."""
    max_age_s: float = Field(default=WriteBackPolicy().interlock_max_age_s, gt=0.0, le=60.0)
    """If the file is not rewritten for longer than this, a write is not safe, whatever its time
    stamp and the host's clock say. [s]"""


class TermsSection(Section):
    """Effects of a repaired model (`ahrsd diagnose --report`), removed before the calibration."""

    model: Path | None = None
    """The model.json; its terms that are functions of a column at each sample are removed; the
    calibration then holds where those columns are at the model's zero."""
    file: Path | None = None
    """File that the vehicle keeps rewriting, a JSON object such as {"motor_current_a": 3.2}, a
    regular file of 4096 bytes at most; temperature comes with the stream."""
    max_age_s: float = Field(default=0.5, gt=0.0, le=60.0)
    """Samples further than this from the last values are not calibrated. [s]"""


class LocationSection(Section):
    """Where the vehicle is, for the field that the world magnetic model expects there."""

    latitude_deg: float | None = Field(default=None, ge=-90.0, le=90.0)
    """Latitude, north positive; without a location the flash is never written. [deg]"""
    longitude_deg: float | None = Field(default=None, ge=-180.0, le=180.0)
    """Longitude, east positive. [deg]"""
    height_m: float = Field(default=0.0, ge=-1000.0, le=100_000.0)
    """Height above the ellipsoid. [m]"""
    date: datetime.date | None = None
    """Date of the model; default: today, for a recording the day it was made."""

    @model_validator(mode="after")
    def _both(self) -> LocationSection:
        if (self.latitude_deg is None) != (self.longitude_deg is None):
            raise ValueError("latitude_deg and longitude_deg must be given together")
        return self


_POLICY = WriteBackPolicy()
_TRIAL = _POLICY.trial
_STILL = _POLICY.still


class WriteBackSection(Section):
    """Who approves a write, and which changes are worth one."""

    approval: Literal["operator", "auto"] = _POLICY.approval
    """operator: a person approves each candidate by its id; auto: a change within
    `gates.max_step_auto_deg` needs nobody."""
    armed_at_start: bool = _POLICY.armed_at_start
    """Begin every run as if a person had sent `ahrsd operator arm`; only approval auto needs it."""
    commit_unattended: bool = _POLICY.commit_unattended
    """Save to flash without an operator's approval (mode commit, approval auto)."""
    keep_on_stop: bool = _POLICY.keep_on_stop
    """Leave values that were not saved in RAM when the daemon stops; otherwise they are undone."""
    min_change_deg: float = Field(default=_POLICY.min_change_deg, ge=0.0, le=180.0)
    """A change of heading below this is not worth a write. [deg]"""
    min_gyro_change_rad_s: float = Field(default=_POLICY.min_gyro_change_rad_s, ge=0.0, le=1.0)
    """A change of the gyro bias below this is not worth a write. [rad/s]"""
    margin_after_rollback: float = Field(default=_POLICY.margin_after_rollback, ge=1.0, le=100.0)
    """After a rollback, only changes larger by this factor are worth a write. [1]"""
    recheck_s: float = Field(default=_POLICY.recheck_s, ge=5.0, le=600.0)
    """Interval at which the identity and registers 23, 25, 26, 44 and 84 are read again, in every
    mode but passive. [s]"""


class TrialSection(Section):
    """The time in which written registers must prove themselves on live data."""

    duration_s: float = Field(default=_TRIAL.duration_s, gt=0.0, le=86400.0)
    """How long, unless the turns below come first; longer proves more. [s]"""
    turns: float = Field(default=_TRIAL.turns, gt=0.0, le=100.0)
    """Full turns that end the trial. [turns]"""
    worse_percent: float = Field(default=_TRIAL.worse_percent, gt=0.0, le=100.0)
    """Roll back if the live figure is worse than with the old registers by this ... [%]"""
    worse_for_s: float = Field(default=_TRIAL.worse_for_s, ge=0.0, le=86400.0)
    """... for this long. [s]"""
    max_wrong_percent: float = Field(default=_TRIAL.max_wrong_percent, gt=0.0, le=100.0)
    """Roll back if an error of the calibration explains more of the corrected field than this, ...
    [%]"""
    wrong_sigmas: float = Field(default=_TRIAL.wrong_sigmas, ge=1.0, le=100.0)
    """... by so many of the figure's own standard deviations. [1]"""
    max_spread_percent: float = Field(default=_TRIAL.max_spread_percent, gt=0.0, le=100.0)
    """Roll back if the corrected field scatters by more than this. [%]"""
    max_jump_deg: float = Field(default=_TRIAL.max_jump_deg, gt=0.0, le=180.0)
    """Roll back if the heading jumps by this much more than predicted. [deg]"""
    interlock: bool = _TRIAL.interlock
    """Roll back if the vehicle reports that it is no longer safe; false if its report is only about
    the moment of writing."""

    def policy(self) -> TrialPolicy:
        """What the write-back takes."""
        return TrialPolicy(**self.model_dump())


class StillSection(Section):
    """Test that the vehicle is at rest before the flash is written."""

    gyro_rad_s: float = Field(default=_STILL.gyro_rad_s, gt=0.0, le=1.0)
    """Rate minus bias below which it is at rest. [rad/s]"""
    accel_m_s2: float = Field(default=_STILL.accel_m_s2, gt=0.0, le=10.0)
    """Standard deviation of the specific force below which it is at rest. [m/s^2]"""
    duration_s: float = Field(default=_STILL.duration_s, gt=0.0, le=3600.0)
    """For how long. [s]"""
    max_age_s: float = Field(default=_STILL.max_age_s, gt=0.0, le=60.0)
    """How old the newest sample may be then. [s]"""

    def policy(self) -> StillPolicy:
        """What the write-back takes."""
        return StillPolicy(**self.model_dump())


class BudgetSection(Section):
    """How often the device may be written."""

    min_interval_s: float = Field(default=_POLICY.min_interval_s, ge=0.0, le=10**6)
    """Between two writes of RAM. [s]"""
    ram_writes_per_day: int = Field(default=_POLICY.ram_writes_per_day, ge=0, le=1000)
    """Writes of RAM. [1/day]"""
    flash_writes_per_day: int = Field(default=_POLICY.flash_writes_per_day, ge=0, le=100)
    """Writes of flash by ahrsd, those by hand included. [1/day]"""
    flash_writes_lifetime: int = Field(default=_POLICY.flash_writes_lifetime, ge=0, le=10_000)
    """Writes of flash over the device's life, by the journal; those of clients included."""
    cooldown_s: float = Field(default=_POLICY.cooldown_s, ge=0.0, le=10**7)
    """No write for this long after a rollback. [s]"""
    rollbacks_to_lock: int = Field(default=_POLICY.rollbacks_to_lock, ge=1, le=100)
    """This number of rollbacks in a row locks the write-back until a person unlocks it."""
