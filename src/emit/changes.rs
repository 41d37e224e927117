//! Several changes of the settings at once, as commands of some protocols hold them: all of them, or none.

use echotank_core::flow::{
    Asked, SettingChange, SettingLimits, SettingRefused, SettingRule, SettingsPort,
};

/// What is outside a limit by no more than an f32 can tell is the limit itself.
const WIRE_PRECISION: f64 = f32::EPSILON as f64;

/// Applies `changes` in order, unless one of them would be refused: then nothing is changed.
pub(crate) fn apply_all(
    settings: &dyn SettingsPort,
    changes: &[SettingChange],
    asked: Asked,
) -> Result<(), SettingRefused> {
    let limits = settings.limits();
    changes
        .iter()
        .try_for_each(|change| fits(&limits, change))?;
    changes
        .iter()
        .try_for_each(|&change| settings.apply(change, asked).map(|_| ()))
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
    // Written so that NaN does not fit.
    if (value - held).abs() <= WIRE_PRECISION * held.abs() {
        return Ok(());
    }
    let rule = match value.is_finite() {
        true => SettingRule::Between { min, max },
        false => SettingRule::Finite,
    };
    Err(SettingRefused { key, value, rule })
}

/// Where `value` lies between the ends of a limit, 0 to 1; 0 where they are one.
pub fn part_of((min, max): (f64, f64), value: f64) -> f64 {
    if max > min {
        ((value - min) / (max - min)).clamp(0.0, 1.0)
    } else {
        0.0
    }
}

/// The reverse of [`part_of`].
pub(crate) fn at_part((min, max): (f64, f64), part: f64) -> f64 {
    min + part * (max - min)
}
