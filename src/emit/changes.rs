//! Applies several setting changes as one transaction: all of them, or none. Some protocols send several changes in one command.

use echotank_core::settings::{
    ChangeOrigin, SettingChange, SettingLimits, SettingRefused, SettingRule, SettingsPort,
};

/// Relative precision of an f32. A value that exceeds a limit by no more than this counts as the limit.
const WIRE_PRECISION: f64 = f32::EPSILON as f64;

/// Applies `changes` in order. If any of them would be refused, nothing changes and the refusal is returned.
pub(crate) fn apply_all(
    settings: &dyn SettingsPort,
    changes: &[SettingChange],
    origin: ChangeOrigin,
) -> Result<(), SettingRefused> {
    let limits = settings.limits();
    changes
        .iter()
        .try_for_each(|change| fits(&limits, change))?;
    changes
        .iter()
        .try_for_each(|&change| settings.apply(change, origin).map(|_| ()))
}

fn fits(limits: &SettingLimits, change: &SettingChange) -> Result<(), SettingRefused> {
    let (key, value, (min, max)) = match *change {
        SettingChange::RangeM(v) => ("range_m", v, limits.range_m),
        SettingChange::MaxPingRateHz(v) if v != 0.0 => ("max_ping_rate_hz", v, limits.ping_rate_hz),
        SettingChange::SourceLevelDb(v) => ("source_level_db", v, limits.source_level_db),
        SettingChange::GainDb(v) => ("gain_db", v, limits.gain_db),
        SettingChange::PulseDurationS(v) => ("pulse_duration_s", v, limits.pulse_duration_s),
        _ => return Ok(()),
    };
    let held = value.clamp(min, max);
    // The comparison is written so that NaN fails it.
    if (value - held).abs() <= WIRE_PRECISION * held.abs() {
        return Ok(());
    }
    let rule = match value.is_finite() {
        true => SettingRule::Between { min, max },
        false => SettingRule::Finite,
    };
    Err(SettingRefused { key, value, rule })
}

/// Relative position of `value` within the limits, 0 (minimum) to 1 (maximum); 0 if both limits are equal.
pub fn part_of((min, max): (f64, f64), value: f64) -> f64 {
    if max > min {
        ((value - min) / (max - min)).clamp(0.0, 1.0)
    } else {
        0.0
    }
}

/// Inverse of [`part_of`].
pub(crate) fn at_part((min, max): (f64, f64), part: f64) -> f64 {
    min + part * (max - min)
}
