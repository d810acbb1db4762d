"""The limits of the gates; names and units are those of the configuration's [gates]."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class GateLimits:
    """One limit per row of the table; docs/reference/gates.md says why each is what it is."""

    max_error_rate: float = 1e-3  # of messages
    max_drop_rate: float = 5e-3  # of samples
    min_rate_hz: float = 10.0
    min_heading_excursion_deg: float = 280.0
    min_planar_circle_deg: float = 340.0
    min_observability: float = 1.0
    max_heading_sigma_deg: float = 1.0
    max_moved_unseen_gauss: float = 0.02
    field_min_gauss: float = 0.22
    field_max_gauss: float = 0.67
    field_model_percent: float = 10.0
    field_spread_ram_percent: float = 2.0
    field_spread_flash_percent: float = 1.0
    max_inclination_error_deg: float = 3.0
    holdout_segments: float = 2.0
    min_holdout_excursion_deg: float = 280.0
    holdout_rms_deg: float = 1.5
    holdout_max_deg: float = 3.0
    closure_deg: float = 2.0
    min_improvement_percent: float = 20.0
    min_improvement_deg: float = 0.3
    min_improvement_lower_deg: float = 0.01
    repeat_hard_iron_gauss: float = 0.01
    repeat_heading_deg: float = 1.0
    second_opinion_deg: float = 2.0
    min_eigenvalue: float = 0.05
    min_diagonal: float = 0.2
    max_diagonal: float = 5.0
    max_condition_auto: float = 2.0
    max_condition_operator: float = 8.0
    max_offset_auto_gauss: float = 0.6
    max_offset_operator_gauss: float = 1.3
    max_scale_change_percent: float = 5.0
    max_step_auto_deg: float = 5.0
    max_step_operator_deg: float = 20.0
    max_field_change_gauss: float = 0.05
    max_inclination_change_deg: float = 2.0
    max_temperature_drift_c: float = 5.0
    max_gyro_bias_deg_s: float = 3.0
    min_rest_s: float = 3.0
    max_gyro_sigma_share: float = 1.0 / 3.0
    max_gyro_disagreement: float = 4.0

    def with_margin(self, margin: float) -> GateLimits:
        """After a rollback: an improvement must be `margin` times as clear."""
        return replace(
            self,
            min_improvement_percent=min(self.min_improvement_percent * margin, 95.0),
            min_improvement_deg=self.min_improvement_deg * margin,
            min_improvement_lower_deg=self.min_improvement_lower_deg * margin,
        )
