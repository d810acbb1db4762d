"""From the configuration to what the pure core takes."""

from __future__ import annotations

import datetime

from ahrsd.config.loading import Config
from ahrsd.core.settings import CalibratorSettings, CoreSettings
from ahrsd.errors import ConfigError
from ahrsd.foreign_file import text_within
from ahrsd.sharing.arbiter import SharePolicy
from ahrsd.world_field import WorldField, world_field
from ahrsd.writeback.policy import WriteBackPolicy

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
            SharePolicy(s.name, s.owner, s.save, s.reset, s.calibration_writes)
            for s in config.share
            if s.pty is not None  # who reads over the network says nothing
        ),
    )


def terms_text(config: Config) -> str:
    """The text of `terms.model`, empty without one.  Raises ConfigError where it is none."""
    path = config.terms.model
    if path is None:
        return ""
    from ahrsd.diagnosis.model_file import from_text  # takes 50 MB: only where there is a model

    try:
        text = text_within(path, _LARGEST_MODEL_BYTES)
        from_text(text)
    except ValueError as error:
        raise ConfigError([f"terms.model = {path}: {error}"]) from error
    return text
