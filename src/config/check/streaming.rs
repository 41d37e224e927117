//! Checks streaming delivery.

use super::super::spec::*;
use crate::keys;
use crate::raw::Problems;
use echotank_core::model::{DopplerModel, Synthesis};

/// Default of `ahead_ms` with streaming, seconds.
const AHEAD_S: f64 = 0.1;

pub(super) fn delivery(table: &keys::Run) -> Option<DeliverySpec> {
    Some(match table.delivery.is("streaming")? {
        false => DeliverySpec::PingEnd,
        true => DeliverySpec::Streaming {
            block_s: table.stream_block_ms.get()?,
            latency_s: table.stream_latency_ms.get()?,
        },
    })
}

pub(super) fn ahead_s(table: &keys::Run) -> Option<f64> {
    match (table.ahead_ms.given, table.delivery.text()?) {
        (true, _) => table.ahead_ms.get(),
        (false, "streaming") => Some(AHEAD_S),
        (false, _) => Some(0.0),
    }
}

/// Refuses tiles with methods that need samples of the whole ping.
pub(crate) fn refuse_tile_conflicts(
    run: &keys::Run,
    sonars: &[&SonarSpec],
    problems: &mut Problems,
) {
    if run.stream_tiles.get() != Some(true) {
        return;
    }
    for sonar in sonars {
        let model = &sonar.model;
        // The replicas of "nearest" and "linear" begin up to a sample before their echoes and thus outside the tile.
        let one_by_one = [Synthesis::Reference, Synthesis::Direct];
        let is_passband = |output: &OutputSpec| matches!(output, OutputSpec::Vita49(output) if output.passband_rate_hz.is_some());
        let why = if sonar.synthesis.auto.any() || !one_by_one.contains(&model.synthesis) {
            "model.synthesis must be \"reference\" or \"direct\", and no method may be \"auto\": other synthesis methods need the whole ping"
        } else if model.doppler == DopplerModel::StretchQuadratic {
            "model.doppler = \"stretch-quadratic\" fits its curves to the whole ping"
        } else if sonar.synthesis.error_check {
            "model.error_check needs the whole ping"
        } else if !sonar.more_pulses.is_empty() {
            "further pulses need the whole ping"
        } else if sonar.outputs.iter().any(is_passband) {
            "passband samples in output.vita49 need the whole ping"
        } else {
            continue;
        };
        problems.refuse(&run.stream_tiles, format!("sonar {}: {why}", sonar.name));
    }
}

/// Refuses computation before the pulse without prediction of the motion.
pub(crate) fn refuse_ahead_without_prediction(
    nav: &NavSpec,
    run: &keys::Run,
    problems: &mut Problems,
) {
    if nav.mode == NavMode::Predict {
        return;
    }
    let rule = "only with nav.mode = \"predict\": the motion after the pulse is not known yet";
    if run.delivery.text() == Some("streaming") {
        problems.refuse(&run.delivery, rule);
    } else if ahead_s(run).is_some_and(|ahead_s| ahead_s > 0.0) {
        problems.refuse(&run.ahead_ms, rule);
    }
}

/// Refuses a prediction time beyond the maximum extrapolation, because every ping would be skipped.
pub(crate) fn refuse_long_prediction(
    nav: &NavSpec,
    run: &keys::Run,
    sonars: &[&SonarSpec],
    medium: &MediumSpec,
    problems: &mut Problems,
) {
    let Some(ahead_s) = ahead_s(run).filter(|&ahead_s| ahead_s > 0.0) else {
        return;
    };
    if nav.mode != NavMode::Predict || nav.on_lost != OnLost::Skip {
        return;
    }
    let windows = sonars.iter().map(|sonar| {
        2.0 * sonar.settings.range_m / medium.sound_speed_m_per_s + sonar.settings.pulse_duration_s
    });
    let longest_s = windows.fold(0.0, f64::max);
    if ahead_s + longest_s > nav.max_extrapolation_s {
        let ms = |s: f64| (s * 1e3).ceil();
        let rule = format!(
            "pings need an extrapolation of {} ms plus a listening window of {} ms, but nav.max_extrapolation_ms = {}: every ping would be skipped",
            ms(ahead_s),
            ms(longest_s),
            ms(nav.max_extrapolation_s)
        );
        problems.refuse(&run.ahead_ms, rule);
    }
}
