//! Imperfections of transducers and receiver.

use std::fmt;

use super::line;
use crate::spec::SonarSpec;
use echotank_core::instrument::{ToneEntry, TransducerResponse};

/// Lines on the imperfections of a sonar; none without any.
pub(super) fn write(out: &mut String, sonar: &SonarSpec) -> fmt::Result {
    let Some(instrument) = &sonar.instrument else {
        return Ok(());
    };
    let mut parts = Vec::new();
    if let Some(leakage) = instrument.leakage {
        let level_db = sonar.settings.source_level_db + leakage.level_db;
        parts.push(match leakage.ring_down {
            None => format!("leakage {level_db} dB re 1 uPa"),
            Some(resonance) => format!(
                "leakage {level_db} dB re 1 uPa, ring-down Q {} ({:.3} ms to -60 dB)",
                resonance.q,
                1e3 * 3.0 * std::f64::consts::LN_10 * resonance.decay_s()
            ),
        });
    }
    let crosstalk = instrument.crosstalk;
    for (db, between) in [
        (crosstalk.elements_db, "elements"),
        (crosstalk.arrays_db, "arrays"),
    ] {
        parts.extend(db.map(|db| format!("crosstalk of {between} {db} dB")));
    }
    match &instrument.response {
        None => {}
        Some(TransducerResponse::Resonance(resonance)) => parts.push(format!(
            "response Q {} at {} kHz",
            resonance.q,
            1e-3 * resonance.frequency_hz
        )),
        Some(TransducerResponse::Table(points)) => {
            parts.push(format!("response of {} points", points.len()));
        }
    }
    let spread = &instrument.element_spread;
    if !spread.measured.is_empty() {
        parts.push(format!("errors of {} elements", spread.measured.len()));
    } else if !spread.is_none() {
        parts.push(format!(
            "elements differ by {} dB and {:.1} deg rms",
            spread.gain_db,
            spread.phase_rad.to_degrees()
        ));
    }
    for tone in &instrument.tones {
        let entry = match tone.entry {
            ToneEntry::Input => "",
            ToneEntry::Baseband => " in baseband",
        };
        let khz = 1e-3 * tone.frequency_hz;
        parts.push(format!(
            "tone {khz} kHz, {} dB re 1 V{entry}",
            tone.level_db
        ));
    }
    for second in &instrument.second_sonars {
        parts.push(format!(
            "second sonar {} kHz every {} ms, {} dB re 1 uPa",
            1e-3 * second.pulse.center_frequency_hz,
            1e3 * second.period_s,
            second.level_db
        ));
    }
    line(out, "  instrument", &parts.join("; "))
}
